"""Writer of USD packages: the skinned avatar, and its surface as a cache of points.

Y up, metres; time codes are the capture's frame numbers. Matrices are transposed on the way in (USD has row vectors).
"""

import struct
import tempfile
from collections.abc import Iterable
from pathlib import Path
from zipfile import ZipFile

import numpy as np
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdSkel, UsdUtils, Vt

from hnerf.asset.quads import polygon_corners
from hnerf.asset.staging import StagedAvatar
from hnerf.body.descriptor import normals_of
from hnerf.capture.capture import write_image
from hnerf.geometry.camera import Camera

ROOT = Sdf.Path("/Avatar")
APERTURE = 0.36  # film gate width in tenths of a scene unit, read as 36 mm where a unit is a metre
TEXTURE_NAME = "texture.png"
FIRST_TIME = bytes([0, 0, 0x21, 0])  # midnight, 1 January 1980, in ZIP's time and date


def write_skinned(path: Path, avatar: StagedAvatar, cameras: Iterable[Camera], fps: float) -> None:
    """Write `avatar.usdz`: mesh, skeleton with the captured motion, material, cameras."""
    with tempfile.TemporaryDirectory() as folder:
        stage = _new_stage(Path(folder) / "avatar.usdc", avatar, cameras, fps)
        body = UsdSkel.Root.Define(stage, ROOT.AppendChild("Body"))
        extents = body.CreateExtentAttr()
        for frame, points in zip(avatar.frames, avatar.points_m, strict=True):
            extents.Set(_extent(points), float(frame))
        mesh = _define_mesh(stage, body.GetPath().AppendChild("Surface"), avatar)
        mesh.CreatePointsAttr(_vec3f(avatar.rest_points_m))
        mesh.CreateExtentAttr(_extent(avatar.rest_points_m))
        mesh.CreateNormalsAttr(_vec3f(normals_of(avatar.rest_points_m, avatar.faces)))
        _bind_skin(mesh, _define_skeleton(stage, body.GetPath().AppendChild("Skeleton"), avatar), avatar)
        _bind_shapes(mesh, avatar)
        _package(stage, avatar, path)


def write_cache(path: Path, avatar: StagedAvatar, cameras: Iterable[Camera], fps: float) -> None:
    """Write `avatar_cache.usdz`: the surface as world-space points at every frame, for programs without skinning."""
    with tempfile.TemporaryDirectory() as folder:
        stage = _new_stage(Path(folder) / "avatar_cache.usdc", avatar, cameras, fps)
        mesh = _define_mesh(stage, ROOT.AppendChild("Surface"), avatar)
        points, extents, normals = mesh.CreatePointsAttr(), mesh.CreateExtentAttr(), mesh.CreateNormalsAttr()
        for frame, posed in zip(avatar.frames, avatar.points_m, strict=True):
            points.Set(_vec3f(posed), float(frame))
            extents.Set(_extent(posed), float(frame))
            normals.Set(_vec3f(normals_of(posed, avatar.faces)), float(frame))
        _package(stage, avatar, path)


def joint_paths(avatar: StagedAvatar) -> list[str]:
    """Return the skeleton's joint tokens, like "root/pelvis_L", every part a valid identifier (Blender drops bones
    whose names are not)."""
    paths: list[str] = []
    for name, parent in zip(avatar.joint_names, avatar.parents, strict=True):
        paths.append(f"{paths[parent]}/{_identifier(name)}" if parent >= 0 else _identifier(name))
    return paths


def define_camera(stage: Usd.Stage, path: Sdf.Path, camera: Camera, stage_from_world: np.ndarray) -> UsdGeom.Camera:
    """Define a pinhole camera as USD has it: it looks along -Z, apertures and focal length in tenths of a scene unit.

    Pixel centres are at integers here, so the principal point lies (cx + 1/2) / W across the image.
    """
    (fx, _, cx), (_, fy, cy), _ = camera.K
    focal = APERTURE * fx / camera.width_px
    vertical_aperture = focal * camera.height_px / fy
    prim = UsdGeom.Camera.Define(stage, path)
    prim.GetPrim().SetDisplayName(camera.name)
    prim.CreateFocalLengthAttr(focal)
    prim.CreateHorizontalApertureAttr(APERTURE)
    prim.CreateVerticalApertureAttr(vertical_aperture)
    prim.CreateHorizontalApertureOffsetAttr(APERTURE * (0.5 - (cx + 0.5) / camera.width_px))
    prim.CreateVerticalApertureOffsetAttr(vertical_aperture * ((cy + 0.5) / camera.height_px - 0.5))
    prim.CreateClippingRangeAttr(Gf.Vec2f(0.01, 1000))
    pose = np.eye(4)
    pose[:3, :3] = stage_from_world @ camera.R.T @ np.diag([1, -1, -1])
    pose[:3, 3] = stage_from_world @ camera.centre_m
    prim.AddTransformOp().Set(Gf.Matrix4d(pose.T))
    return prim


def _new_stage(file: Path, avatar: StagedAvatar, cameras: Iterable[Camera], fps: float) -> Usd.Stage:
    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(float(avatar.frames[0]))
    stage.SetEndTimeCode(float(avatar.frames[-1]))
    root = UsdGeom.Xform.Define(stage, ROOT)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    stage.SetDefaultPrim(root.GetPrim())
    folder = UsdGeom.Scope.Define(stage, ROOT.AppendChild("Cameras")).GetPath()
    for camera in cameras:
        path = folder.AppendChild(_free_name(stage, folder, camera.name))
        define_camera(stage, path, camera, avatar.stage_from_world)
    return stage


def _free_name(stage: Usd.Stage, folder: Sdf.Path, name: str) -> str:
    identifier = _identifier(name)
    while stage.GetPrimAtPath(folder.AppendChild(identifier)):
        identifier += "_"
    return identifier


def _identifier(name: str) -> str:
    """Return a valid prim name; MakeValidIdentifier alone would drop a leading digit, so that 01 and 11 would clash."""
    return Tf.MakeValidIdentifier(f"_{name}" if name[:1].isdigit() else name)


def _define_mesh(stage: Usd.Stage, path: Sdf.Path, avatar: StagedAvatar) -> UsdGeom.Mesh:
    """Define topology, texture coordinates and material; the caller sets points, normals and extents."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    corners = polygon_corners(avatar.faces)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(corners), corners.shape[1], np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(avatar.faces.ravel()[corners].astype(np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    st.Set(Vt.Vec2fArray.FromNumpy(avatar.uvs.astype(np.float32)))
    st.SetIndices(Vt.IntArray.FromNumpy(avatar.face_uvs.ravel()[corners].astype(np.int32).ravel()))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(_define_material(stage))
    return mesh


def _define_material(stage: Usd.Stage) -> UsdShade.Material:
    """Define a matte preview surface with the baked texture."""
    material = UsdShade.Material.Define(stage, ROOT.AppendPath("Materials/Captured"))
    UsdGeom.Scope.Define(stage, material.GetPath().GetParentPath())
    reader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("TextureCoordinates"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    texture = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Texture"))
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(TEXTURE_NAME)
    texture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
    for wrap in ("wrapS", "wrapT"):
        texture.CreateInput(wrap, Sdf.ValueTypeNames.Token).Set("clamp")
    coordinates = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
    surface = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    colour = texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(colour)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material


def _define_skeleton(stage: Usd.Stage, path: Sdf.Path, avatar: StagedAvatar) -> UsdSkel.Skeleton:
    """Define the skeleton: rest transforms relative to parents, bind transforms in the skeleton's space, and the
    motion."""
    joints = joint_paths(avatar)
    skeleton = UsdSkel.Skeleton.Define(stage, path)
    skeleton.CreateJointsAttr(joints)
    skeleton.CreateJointNamesAttr(avatar.joint_names)
    skeleton.CreateRestTransformsAttr(_translations(avatar.rest_offsets_m))
    skeleton.CreateBindTransformsAttr(_translations(avatar.rest_joints_m))
    motion = UsdSkel.Animation.Define(stage, path.AppendChild("Motion"))
    motion.CreateJointsAttr(joints)
    motion.CreateScalesAttr(Vt.Vec3hArray(len(joints), Gf.Vec3h(1, 1, 1)))
    translations, rotations = motion.CreateTranslationsAttr(), motion.CreateRotationsAttr()
    for frame, offsets_m, quaternions in zip(avatar.frames, avatar.translations_m, avatar.quaternions, strict=True):
        translations.Set(_vec3f(offsets_m), float(frame))
        rotations.Set(Vt.QuatfArray([Gf.Quatf(w, x, y, z) for x, y, z, w in quaternions.tolist()]), float(frame))
    motion.CreateBlendShapesAttr(_shape_names(avatar))
    weights = motion.CreateBlendShapeWeightsAttr()
    for frame, values in zip(avatar.frames, avatar.shape_weights, strict=True):
        weights.Set(Vt.FloatArray.FromNumpy(np.ascontiguousarray(values, np.float32)), float(frame))
    binding = UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
    binding.CreateAnimationSourceRel().SetTargets([motion.GetPath()])
    return skeleton


def _bind_skin(mesh: UsdGeom.Mesh, skeleton: UsdSkel.Skeleton, avatar: StagedAvatar) -> None:
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1))
    influences = avatar.skin_joints.shape[1]
    indices = binding.CreateJointIndicesPrimvar(False, influences)
    indices.Set(Vt.IntArray.FromNumpy(avatar.skin_joints.astype(np.int32).ravel()))
    weights = binding.CreateJointWeightsPrimvar(False, influences)
    weights.Set(Vt.FloatArray.FromNumpy(avatar.skin_weights.astype(np.float32).ravel()))


def _bind_shapes(mesh: UsdGeom.Mesh, avatar: StagedAvatar) -> None:
    """Define the corrective blend shapes below the mesh; the skeleton's motion has their weights."""
    names, targets = _shape_names(avatar), []
    for name, offsets_m in zip(names, avatar.shapes_m, strict=True):
        shape = UsdSkel.BlendShape.Define(mesh.GetPrim().GetStage(), mesh.GetPath().AppendChild(name))
        shape.CreateOffsetsAttr(_vec3f(offsets_m))
        targets.append(shape.GetPath())
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateBlendShapesAttr(names)
    binding.CreateBlendShapeTargetsRel().SetTargets(targets)


def _shape_names(avatar: StagedAvatar) -> list[str]:
    return [f"corrective_{k + 1:02d}" for k in range(len(avatar.shapes_m))]


def _package(stage: Usd.Stage, avatar: StagedAvatar, path: Path) -> None:
    layer = Path(stage.GetRootLayer().realPath)
    stage.GetRootLayer().Save()
    write_image(layer.parent / TEXTURE_NAME, avatar.texture)
    if not UsdUtils.CreateNewARKitUsdzPackage(str(layer), str(path)):
        raise OSError(f"{path}: USD could not write the package; is the disk full?")
    _forget_times(path)


def _forget_times(path: Path) -> None:
    """Set the times of all files in a package to the first that ZIP knows, so that the same avatar is the same bytes.

    APPNOTE.TXT of PKWARE, 4.3.7 and 4.3.12: time and date lie at byte 10 of a local header and at byte 12 of an entry
    of the directory, whose name, extra field and comment have the lengths at byte 28.
    """
    package = bytearray(path.read_bytes())
    with ZipFile(path) as archive:
        at, entries = archive.start_dir, archive.infolist()
    for entry in entries:
        for place in (entry.header_offset + 10, at + 12):
            package[place : place + 4] = FIRST_TIME
        at += 46 + sum(struct.unpack_from("<3H", package, at + 28))
    path.write_bytes(package)


def _vec3f(values: np.ndarray) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))


def _extent(points_m: np.ndarray) -> Vt.Vec3fArray:
    return _vec3f(np.stack([points_m.min(0), points_m.max(0)]))


def _translations(offsets_m: np.ndarray) -> Vt.Matrix4dArray:
    return Vt.Matrix4dArray([Gf.Matrix4d(1).SetTranslate(Gf.Vec3d(*offset)) for offset in offsets_m.tolist()])

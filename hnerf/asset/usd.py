"""Prims of USD files: geometry, look, rigs, motions, cameras and splats, each at its place below /Avatar.

Y up, metres. Matrices are transposed when they are written (USD uses row vectors).
"""

from collections.abc import Iterable

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdLux, UsdShade, UsdSkel, UsdVol, Vt

from hnerf.asset.quads import polygon_corners
from hnerf.asset.rigs import FULL, StagedRig
from hnerf.asset.skeleton import Skeleton
from hnerf.asset.splats import OPACITY, Splats
from hnerf.asset.srgb import to_linear
from hnerf.asset.staging import CAPTURED, REST_POSE, StagedAvatar, box, moved_points, opengl_pose, shape_names
from hnerf.body.skeletons import EQUIVALENTS, OWN, SKELETONS, JointNames, name_in
from hnerf.geometry.camera import Camera

ROOT = Sdf.Path("/Avatar")
BODY = ROOT.AppendChild("Body")
SKELETON, MOTION = (BODY.AppendChild(name) for name in ("Skeleton", "Motion"))
SIGMAS = 3  # from a splat's centre to the end of its box
APERTURE = 0.36  # film gate width in tenths of a scene unit, read as 36 mm where a unit is a metre
TEXTURE_NAMES = {"captured": "texture.png", "albedo": "albedo.png"}  # by look
LIGHT_NAME, NORMAL_MAP_NAME = "light.png", "normal_map.png"
MATTE = {"roughness": 1.0, "metallic": 0.0, "ior": 1.0}  # no sheen: what there was is already in the colours
REST_NOTE = (
    f"Rest pose: {REST_POSE}, arms slanting down, elbows and knees a little bent; soles at height 0, facing +Z. The "
    "root joint stands on the ground below the pelvis; it moves over the ground and turns about the vertical with it."
)


def surface_path(level: int) -> Sdf.Path:
    """Return the path of the mesh at a level of detail. Each level has its own prim, since rigs have weights for
    each."""
    return BODY.AppendChild(f"Surface_lod{level}" if level else "Surface")


def look_path(name: str) -> Sdf.Path:
    """Return the path of the material of a look."""
    return ROOT.AppendPath(f"Materials/{name.capitalize()}")


def author_geometry(stage: Usd.Stage, avatar: StagedAvatar, level: int) -> None:
    """Define the skinned mesh at a level of detail, with its blend shapes. `author_shape` sets its points, and
    `author_rig` binds it."""
    UsdSkel.Root.Define(stage, BODY)
    path, kept = surface_path(level), avatar.levels[level].vertices
    mesh = define_mesh(stage, path, avatar, level)
    shapes = []
    for name, offsets_m in avatar.blend_shapes_m.items():
        moved = moved_points(offsets_m[kept])
        shapes.append(UsdSkel.BlendShape.Define(stage, path.AppendChild(name)))
        shapes[-1].CreateOffsetsAttr(vec3f(offsets_m[kept][moved]))
        shapes[-1].CreateNormalOffsetsAttr(vec3f(avatar.normal_changes[name][kept][moved]))
        shapes[-1].CreatePointIndicesAttr(Vt.IntArray.FromNumpy(moved.astype(np.int32)))
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1))
    binding.CreateBlendShapesAttr([shape.GetPrim().GetName() for shape in shapes])
    binding.CreateBlendShapeTargetsRel().SetTargets([shape.GetPath() for shape in shapes])


def author_shape(stage: Usd.Stage, avatar: StagedAvatar, physique: str | None) -> None:
    """Set the points of the mesh at rest at all levels of detail, as captured or in another physique. For the latter,
    the body's extent becomes a box around it in any motion."""
    points_m, normals = avatar.rest_points_m, avatar.normals
    if physique is not None:
        points_m = points_m + avatar.physiques_m[physique]
        normals = normals + avatar.normal_changes[physique]
    for number, level in enumerate(avatar.levels):
        mesh = UsdGeom.Mesh(stage.OverridePrim(surface_path(number)))
        mesh.CreatePointsAttr(vec3f(points_m[level.vertices]))
        mesh.CreateExtentAttr(extent(points_m[level.vertices]))
        mesh.CreateNormalsAttr(vec3f(normals[level.vertices]))
    if physique is not None:
        UsdGeom.Boundable(stage.OverridePrim(BODY)).CreateExtentAttr(vec3f(physique_box(avatar, physique)))


def physique_box(avatar: StagedAvatar, name: str) -> np.ndarray:
    """Return a box (2, 3) that holds a physique in all motions: the captured body's box, grown by the greatest
    displacement of the physique. (Skinning lengthens no displacement: its weights are not negative and sum to 1.)"""
    boxes, moved_m = np.concatenate(list(avatar.extents_m.values())), avatar.physiques_m[name]
    grown_m = np.linalg.norm(moved_m, axis=1).max()
    return np.stack([boxes[:, 0].min(0) - grown_m, boxes[:, 1].max(0) + grown_m])


def author_look(
    stage: Usd.Stage, name: str, meshes: Iterable[Sdf.Path], avatar: StagedAvatar, prefix: str = ""
) -> None:
    """Define the material of one of the avatar's looks, a matte preview surface with its texture and the normal map,
    and bind meshes to it; for the albedo, also define the recording's light. prefix: of the names of images."""
    material = UsdShade.Material.Define(stage, look_path(name))
    UsdGeom.Scope.Define(stage, material.GetPath().GetParentPath())
    reader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("TextureCoordinates"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    coordinates = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    path = material.GetPath().AppendChild("Texture")
    texture = _define_texture(stage, path, prefix + TEXTURE_NAMES[name], "sRGB", coordinates)
    surface = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    for given, value in MATTE.items():
        surface.CreateInput(given, Sdf.ValueTypeNames.Float).Set(value)
    colour = texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(colour)
    if avatar.normal_map is not None:
        path = material.GetPath().AppendChild("NormalMap")
        normals = _define_texture(stage, path, prefix + NORMAL_MAP_NAME, "raw", coordinates)
        normals.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
        normals.CreateInput("bias", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
        normal = normals.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
        surface.CreateInput("normal", Sdf.ValueTypeNames.Normal3f).ConnectToSource(normal)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    for mesh in meshes:
        UsdShade.MaterialBindingAPI.Apply(stage.OverridePrim(mesh)).Bind(material)
    if name == "albedo" and avatar.albedo:
        light = UsdLux.DomeLight.Define(stage, ROOT.AppendChild("Light"))
        light.CreateIntensityAttr(avatar.albedo.dome[1])
        light.CreateTextureFileAttr(f"./{prefix}{LIGHT_NAME}")
        light.CreateTextureFormatAttr(UsdLux.Tokens.latlong)


def _define_texture(
    stage: Usd.Stage, path: Sdf.Path, file: str, colour_space: str, coordinates: UsdShade.Output
) -> UsdShade.Shader:
    texture = UsdShade.Shader.Define(stage, path)
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./{file}")  # without "./" USD searches for it elsewhere
    texture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set(colour_space)
    for wrap in ("wrapS", "wrapT"):
        texture.CreateInput(wrap, Sdf.ValueTypeNames.Token).Set("clamp")
    texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(coordinates)
    return texture


def author_rig(stage: Usd.Stage, name: str, rig: StagedRig, avatar: StagedAvatar) -> None:
    """Define a rig: its skeleton, the skin weights of the mesh at all levels of detail, and which motions belong to
    it."""
    skeleton = UsdSkel.Skeleton.Define(stage, SKELETON)
    names = avatar.joint_names
    skeleton.CreateJointsAttr(joint_paths(rig.skeleton, names))
    skeleton.CreateJointNamesAttr([name_in(names, joint) for joint in rig.skeleton.names])
    skeleton.CreateRestTransformsAttr(_matrices(rig.skeleton.local(rig.skeleton.bind)))
    skeleton.CreateBindTransformsAttr(_matrices(rig.skeleton.bind))
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([MOTION.AppendChild(name)])
    skeleton.GetPrim().SetDocumentation(REST_NOTE)
    skeleton.GetPrim().SetCustomData({"restPose": REST_POSE, "jointNamesIn": _names_elsewhere(rig.skeleton, names)})
    influences = rig.skin.joints.shape[1]
    for number, level in enumerate(avatar.levels):
        binding = UsdSkel.BindingAPI.Apply(stage.OverridePrim(surface_path(number)))
        binding.CreateSkeletonRel().SetTargets([SKELETON])
        indices = binding.CreateJointIndicesPrimvar(False, influences)
        indices.Set(Vt.IntArray.FromNumpy(rig.skin.joints[level.vertices].astype(np.int32).ravel()))
        weights = binding.CreateJointWeightsPrimvar(False, influences)
        weights.Set(Vt.FloatArray.FromNumpy(rig.skin.weights[level.vertices].astype(np.float32).ravel()))


def author_motion(stage: Usd.Stage, name: str, avatar: StagedAvatar) -> None:
    """Define a motion for every rig, and the body's extents in it, at the same instants in the stage's time codes."""
    UsdGeom.Scope.Define(stage, MOTION)
    boxes = UsdGeom.Boundable(stage.OverridePrim(BODY)).CreateExtentAttr()
    full = avatar.rigs[FULL].motions[name]
    codes = full.codes * (stage.GetTimeCodesPerSecond() / full.fps)
    for box_m, code in zip(avatar.extents_m[name], codes, strict=True):
        boxes.Set(vec3f(box_m), code)
    for rig_name, rig in avatar.rigs.items():
        motion = rig.motions[name]
        joints = joint_paths(rig.skeleton, avatar.joint_names)
        animation = UsdSkel.Animation.Define(stage, MOTION.AppendChild(rig_name))
        animation.CreateJointsAttr(joints)
        animation.CreateScalesAttr(Vt.Vec3hArray(len(joints), Gf.Vec3h(1, 1, 1)))
        animation.CreateBlendShapesAttr(shape_names(avatar))
        translations, rotations = animation.CreateTranslationsAttr(), animation.CreateRotationsAttr()
        weights = animation.CreateBlendShapeWeightsAttr()
        for k, code in enumerate(codes):
            translations.Set(vec3f(motion.translations_m[k]), code)
            rotations.Set(Vt.QuatfArray.FromNumpy(motion.quaternions[k].astype(np.float32)), code)  # real part last
            weights.Set(Vt.FloatArray.FromNumpy(np.ascontiguousarray(motion.shape_weights[k], np.float32)), code)


def author_cameras(stage: Usd.Stage, cameras: Iterable[Camera], stage_from_world: np.ndarray) -> None:
    """Define the recording's cameras."""
    folder = UsdGeom.Scope.Define(stage, ROOT.AppendChild("Cameras")).GetPath()
    for camera in cameras:
        define_camera(stage, folder.AppendChild(_free_name(stage, folder, camera.name)), camera, stage_from_world)


def author_splats(stage: Usd.Stage, avatar: StagedAvatar, splats: Splats) -> None:
    """Define the splats. Since the schema cannot skin them, they have centres and orientations (half precision) at each
    frame of the captured motion, as the full rig moves the surface with its blend shapes."""
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, ROOT.AppendChild("Splats"))
    count = len(splats.face)
    prim.CreateScalesAttr(vec3f(np.tile(splats.scales_m, (count, 1))))
    prim.CreateOpacitiesAttr(Vt.FloatArray(count, OPACITY))
    prim.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    prim.CreateRadianceSphericalHarmonicsCoefficientsAttr(vec3f(splats.coefficients))
    Usd.ColorSpaceAPI.Apply(prim.GetPrim()).CreateColorSpaceNameAttr(Gf.ColorSpaceNames.SRGBRec709)
    positions, orientations, boxes = prim.CreatePositionsAttr(), prim.CreateOrientationshAttr(), prim.CreateExtentAttr()
    everywhere = []
    surfaces_m = avatar.rigs[FULL].surfaces_m(CAPTURED, avatar.rest)
    for frame, surface_m in zip(avatar.frames.astype(float).tolist(), surfaces_m, strict=True):
        middles_m, _, quaternions = splats.on(surface_m)
        box_m = box(middles_m) + SIGMAS * splats.sigma_m * np.array([[-1], [1]])
        positions.Set(vec3f(middles_m), frame)
        # USD keeps the real part last.
        orientations.Set(Vt.QuathArray.FromNumpy(quaternions[:, [1, 2, 3, 0]].astype(np.float16)), frame)
        boxes.Set(vec3f(box_m), frame)
        everywhere.append(box_m)
    UsdGeom.ModelAPI(stage.GetDefaultPrim()).SetExtentsHint(extent(np.concatenate(everywhere)))


def joint_paths(skeleton: Skeleton, names: JointNames) -> list[str]:
    """Return the skeleton's joint tokens, like "root/pelvis/thigh_L", every part a valid identifier (Blender drops
    bones whose names are not)."""
    paths: list[str] = []
    for joint, parent in zip(skeleton.names, skeleton.parents, strict=True):
        name = _identifier(name_in(names, joint))
        paths.append(f"{paths[parent]}/{name}" if parent >= 0 else name)
    return paths


def _names_elsewhere(skeleton: Skeleton, names: JointNames) -> dict[str, dict[str, str]]:
    """Return the joints' names in other skeletons, by skeleton and by the name that the joint has in the file; and, if
    that is not its own, its own name."""
    known = {name_in(names, joint): EQUIVALENTS[joint] for joint in skeleton.names if joint in EQUIVALENTS}
    elsewhere = {s: {called: getattr(n, s) for called, n in known.items() if getattr(n, s)} for s in SKELETONS}
    own = {name_in(names, joint): joint for joint in skeleton.names if name_in(names, joint) != joint}
    return elsewhere | ({OWN: own} if own else {})


def define_camera(stage: Usd.Stage, path: Sdf.Path, camera: Camera, stage_from_world: np.ndarray) -> UsdGeom.Camera:
    """Define a pinhole camera in USD's conventions: it looks along -Z, apertures and focal length are in tenths of a
    scene unit.

    Pixel centres are at integers here, so the principal point lies (cx + 1/2) / W across the image. The custom data has
    the image's size, for which USD has no attribute.
    """
    (fx, _, cx), (_, fy, cy), _ = camera.K
    focal = APERTURE * fx / camera.width_px
    vertical_aperture = focal * camera.height_px / fy
    prim = UsdGeom.Camera.Define(stage, path)
    prim.GetPrim().SetDisplayName(camera.name)
    prim.GetPrim().SetCustomData({"imageWidth": camera.width_px, "imageHeight": camera.height_px})
    prim.CreateFocalLengthAttr(focal)
    prim.CreateHorizontalApertureAttr(APERTURE)
    prim.CreateVerticalApertureAttr(vertical_aperture)
    prim.CreateHorizontalApertureOffsetAttr(APERTURE * (0.5 - (cx + 0.5) / camera.width_px))
    prim.CreateVerticalApertureOffsetAttr(vertical_aperture * ((cy + 0.5) / camera.height_px - 0.5))
    prim.CreateClippingRangeAttr(Gf.Vec2f(0.01, 1000))
    prim.AddTransformOp().Set(Gf.Matrix4d(opengl_pose(camera, stage_from_world).T))
    return prim


def _free_name(stage: Usd.Stage, folder: Sdf.Path, name: str) -> str:
    identifier = _identifier(name)
    while stage.GetPrimAtPath(folder.AppendChild(identifier)):
        identifier += "_"
    return identifier


def _identifier(name: str) -> str:
    """Return a valid prim name; MakeValidIdentifier alone would drop a leading digit, so that 01 and 11 would clash."""
    return Tf.MakeValidIdentifier(f"_{name}" if name[:1].isdigit() else name)


def define_mesh(stage: Usd.Stage, path: Sdf.Path, avatar: StagedAvatar, level: int) -> UsdGeom.Mesh:
    """Define topology, texture coordinates and display colours; the caller sets points, normals and extents."""
    mesh, shown = UsdGeom.Mesh.Define(stage, path), avatar.levels[level]
    corners = polygon_corners(shown.layout.face_uvs)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(corners), corners.shape[1], np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(shown.faces.ravel()[corners].astype(np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    st.Set(Vt.Vec2fArray.FromNumpy(shown.layout.uvs.astype(np.float32)))
    st.SetIndices(Vt.IntArray.FromNumpy(shown.layout.face_uvs.ravel()[corners].astype(np.int32).ravel()))
    colours = to_linear(avatar.vertex_colours[shown.vertices] / 255)
    mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(vec3f(colours))
    return mesh


def vec3f(values: np.ndarray) -> Vt.Vec3fArray:
    """Return vectors (n, 3) as USD's array."""
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))


def extent(points_m: np.ndarray) -> Vt.Vec3fArray:
    """Return the box around points (n, 3) as USD's array of two corners."""
    return vec3f(box(points_m))


def _matrices(transforms: np.ndarray) -> Vt.Matrix4dArray:
    return Vt.Matrix4dArray.FromNumpy(np.ascontiguousarray(transforms.swapaxes(1, 2)))

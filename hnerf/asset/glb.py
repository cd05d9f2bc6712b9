"""Writer of glTF binary files: the skinned, textured, animated avatar in one file (glTF 2.0 specification, Khronos
Group)."""

from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pygltflib as gltf
from scipy.spatial.transform import Rotation

from hnerf.asset.package import AssetInfo
from hnerf.asset.rigs import JointMotion, StagedRig
from hnerf.asset.skeleton import Skeleton
from hnerf.asset.skinning import Skin
from hnerf.asset.staging import CAPTURED, RATES, StagedAvatar, moved_points
from hnerf.asset.tangents import uv_tangents
from hnerf.asset.texture import UvLayout
from hnerf.body.skeletons import JointNames, name_in

COMPONENT_TYPES = {"float32": gltf.FLOAT, "uint16": gltf.UNSIGNED_SHORT, "uint32": gltf.UNSIGNED_INT}
RESAMPLED = [f"{CAPTURED}_{rate}" for rate in RATES]  # left out: glTF times are in seconds
VARIANTS, SPECULAR, UNLIT = "KHR_materials_variants", "KHR_materials_specular", "KHR_materials_unlit"
LOOKS = {"captured": {UNLIT: {}}, "albedo": {SPECULAR: {"specularFactor": 0.0}}}  # no sheen: it is in the colours
DENSE_SHARE = 0.75  # of the vertices; if a blend shape moves more, 4-byte indices cost more than 12-byte zeros
STILL = 1e-6  # metres or radians; a joint that moves less stays at rest
SHAPES = {(): gltf.SCALAR, (2,): gltf.VEC2, (3,): gltf.VEC3, (4,): gltf.VEC4, (4, 4): gltf.MAT4}


class GlbWriter:
    """A glTF document whose arrays all lie in one binary chunk."""

    def __init__(self) -> None:
        self.document = gltf.GLTF2(scene=0, scenes=[gltf.Scene(nodes=[])], buffers=[gltf.Buffer()])
        self._chunk = bytearray()

    def view(self, data: bytes, target: int | None = None) -> int:
        """Append bytes, aligned to four; return the index of the buffer view."""
        self._chunk.extend(bytes(-len(self._chunk) % 4))
        self.document.bufferViews.append(
            gltf.BufferView(buffer=0, byteOffset=len(self._chunk), byteLength=len(data), target=target)
        )
        self._chunk.extend(data)
        return len(self.document.bufferViews) - 1

    def accessor(self, values: np.ndarray, target: int | None = None) -> int:
        """Append an array whose first axis counts the elements; return the index of the accessor."""
        flat, view = values.reshape(len(values), -1), self.view(np.ascontiguousarray(values).tobytes(), target)
        return self._add(values, len(values), flat.min(0), flat.max(0), bufferView=view)

    def sparse_accessor(self, values: np.ndarray, at: int, count: int) -> int:
        """Append an array of `count` elements that are zero except for n < count float32 values (n, C); return the
        index of the accessor. at: the buffer view of their indices, uint32 in ascending order."""
        sparse = gltf.Sparse(
            count=len(values),
            indices=gltf.AccessorSparseIndices(bufferView=at, componentType=gltf.UNSIGNED_INT),
            values=gltf.AccessorSparseValues(bufferView=self.view(np.ascontiguousarray(values).tobytes())),
        )
        low, high = np.minimum(values.min(0), 0), np.maximum(values.max(0), 0)
        return self._add(values, count, low, high, byteOffset=None, sparse=sparse)

    def _add(self, values: np.ndarray, count: int, low: np.ndarray, high: np.ndarray, **content: Any) -> int:
        """Append an accessor of `count` elements like those of `values`, from low to high; return its index."""
        kind = {"componentType": COMPONENT_TYPES[values.dtype.name], "type": SHAPES[values.shape[1:]]}
        limits = {"min": low.tolist(), "max": high.tolist()}
        self.document.accessors.append(gltf.Accessor(count=count, **kind, **limits, **content))
        return len(self.document.accessors) - 1

    def save(self, path: Path) -> None:
        """Write the document to a file."""
        self.document.buffers[0].byteLength = len(self._chunk)
        self.document.set_binary_blob(bytes(self._chunk))
        self.document.save_binary(path)


def write_glb(path: Path, avatar: StagedAvatar, rig: StagedRig, info: AssetInfo) -> None:
    """Write a rig of the avatar with all its motions except the resampled ones. Joints are nodes 0 to J-1, the mesh is
    node J; time 0 is a motion's first instant. Mesh and skin are named as in USD; Blender shows these names. glTF calls
    the licence the copyright."""
    writer = GlbWriter()
    document = writer.document
    document.asset.generator, document.asset.copyright = "hnerf", info.licence or None
    document.asset.extras = {"version": info.version, "captureDigest": info.capture}
    _add_joints(document, rig.skeleton, avatar.joint_names)
    names = [*avatar.blend_shapes_m, *avatar.physiques_m]
    primitive = _primitive(writer, avatar, rig.skin)
    _add_materials(writer, avatar, primitive)
    document.meshes.append(
        gltf.Mesh(
            name="Surface", primitives=[primitive], weights=[0.0] * len(names) or None, extras={"targetNames": names}
        )
    )
    inverse_bind = np.linalg.inv(rig.skeleton.bind).swapaxes(1, 2).astype(np.float32)  # stored by columns
    joints = list(range(len(rig.skeleton.names)))
    bind = writer.accessor(inverse_bind)
    document.skins.append(gltf.Skin(name="Skeleton", inverseBindMatrices=bind, joints=joints, skeleton=0))
    document.nodes.append(gltf.Node(name="Surface", mesh=0, skin=0))
    document.scenes[0].nodes = [0, len(joints)]
    motions = {name: motion for name, motion in rig.motions.items() if name not in RESAMPLED}
    moved = [_moved(motion, rig.skeleton) for motion in motions.values()]
    in_any = np.any(moved, 0)
    for (name, motion), in_this in zip(motions.items(), moved, strict=True):
        document.animations.append(_animation(writer, name, motion, len(names), in_this, in_any))
    writer.save(path)


def _add_joints(document: gltf.GLTF2, skeleton: Skeleton, names: JointNames) -> None:
    local = skeleton.local(skeleton.bind)
    quaternions = Rotation.from_matrix(local[:, :3, :3]).as_quat()
    for joint, name in enumerate(skeleton.names):
        place, turn = local[joint, :3, 3].tolist(), quaternions[joint].tolist()
        below = np.nonzero(skeleton.parents == joint)[0].tolist()
        called = name_in(names, name, prefixed=True)
        document.nodes.append(gltf.Node(name=called, translation=place, rotation=turn, children=below))


def _primitive(writer: GlbWriter, avatar: StagedAvatar, skin: Skin) -> gltf.Primitive:
    """Add the mesh with its correctives, expressions and physiques, its vertices split at the texture's seams; skin
    influences beyond four go into a second set."""
    vertex = np.zeros(len(avatar.uvs), np.int64)
    vertex[avatar.face_uvs] = avatar.faces
    attributes = gltf.Attributes(
        POSITION=_vertex_data(writer, avatar.rest_points_m[vertex], np.float32),
        NORMAL=_vertex_data(writer, avatar.normals[vertex], np.float32),
        TEXCOORD_0=_vertex_data(writer, avatar.uvs * (1, -1) + (0, 1), np.float32),  # v runs down in glTF
    )
    if avatar.normal_map is not None:
        layout = UvLayout(avatar.uvs, avatar.face_uvs)
        tangents = uv_tangents(avatar.rest_points_m, avatar.normals, avatar.faces, layout)
        attributes.TANGENT = _vertex_data(writer, tangents, np.float32)
    missing = -skin.joints.shape[1] % 4
    joints, weights = (np.pad(a, ((0, 0), (0, missing)))[vertex] for a in (skin.joints, skin.weights))
    for start in range(0, joints.shape[1], 4):
        setattr(attributes, f"JOINTS_{start // 4}", _vertex_data(writer, joints[:, start : start + 4], np.uint16))
        setattr(attributes, f"WEIGHTS_{start // 4}", _vertex_data(writer, weights[:, start : start + 4], np.float32))
    indices = writer.accessor(avatar.face_uvs.astype(np.uint32).ravel(), gltf.ELEMENT_ARRAY_BUFFER)
    shapes = avatar.blend_shapes_m | avatar.physiques_m
    targets = [_target(writer, shapes[name][vertex], avatar.normal_changes[name][vertex]) for name in shapes]
    return gltf.Primitive(attributes=attributes, indices=indices, material=0, targets=targets or None)


def _target(writer: GlbWriter, offsets_m: np.ndarray, normal_changes: np.ndarray) -> gltf.Attributes:
    """Add a blend shape: its offsets and its changes of normals, both (V, 3)."""
    changes = offsets_m.astype(np.float32), normal_changes.astype(np.float32)
    moved = moved_points(offsets_m)
    if len(moved) > DENSE_SHARE * len(offsets_m):
        place, turn = (writer.accessor(values, gltf.ARRAY_BUFFER) for values in changes)
    else:
        at = writer.view(moved.astype(np.uint32).tobytes())
        place, turn = (writer.sparse_accessor(values[moved], at, len(offsets_m)) for values in changes)
    return gltf.Attributes(POSITION=place, NORMAL=turn)


def _vertex_data(writer: GlbWriter, values: np.ndarray, dtype: type) -> int:
    return writer.accessor(values.astype(dtype), gltf.ARRAY_BUFFER)


def _add_materials(writer: GlbWriter, avatar: StagedAvatar, primitive: gltf.Primitive) -> None:
    """Add the captured look, which the primitive uses and which is unlit, since light is in its colours, and, if there
    is an albedo, a material variant for it."""
    document = writer.document
    document.extensionsUsed = [UNLIT]
    document.samplers.append(gltf.Sampler(wrapS=gltf.CLAMP_TO_EDGE, wrapT=gltf.CLAMP_TO_EDGE))
    normals = None if avatar.normal_map is None else _add_texture(writer, avatar.normal_map)
    for name, texture in avatar.looks.items():
        colours = gltf.TextureInfo(index=_add_texture(writer, texture))
        matte = gltf.PbrMetallicRoughness(baseColorTexture=colours, metallicFactor=0.0, roughnessFactor=1.0)
        material = gltf.Material(name=name.capitalize(), pbrMetallicRoughness=matte, extensions=LOOKS[name])
        if normals is not None:
            material.normalTexture = gltf.NormalMaterialTexture(index=normals)
        document.materials.append(material)
    if avatar.albedo:
        document.extensionsUsed += [SPECULAR, VARIANTS]
        document.extensions = {VARIANTS: {"variants": [{"name": name} for name in avatar.looks]}}
        mappings = [{"material": k, "variants": [k]} for k in range(len(avatar.looks))]
        primitive.extensions = {VARIANTS: {"mappings": mappings}}


def _add_texture(writer: GlbWriter, image: np.ndarray) -> int:
    """Add an image (H, W, 3) uint8 as PNG; return the index of its texture."""
    _, png = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.document.images.append(gltf.Image(bufferView=writer.view(png.tobytes()), mimeType="image/png"))
    writer.document.textures.append(gltf.Texture(source=len(writer.document.images) - 1, sampler=0))
    return len(writer.document.textures) - 1


def _animation(
    writer: GlbWriter, name: str, motion: JointMotion, shapes: int, in_this: np.ndarray, in_any: np.ndarray
) -> gltf.Animation:
    """Add channels for what moves in any motion: joints that leave their transform at rest, and the weights of the
    correctives. The expressions and physiques that follow the correctives, up to `shapes` in all, have weight 0. Joints
    that stay at rest in this motion have two keys, the first and the last, and so have weights that are all 0, in case
    another motion left them at other values. in_this, in_any (J, 2): what `_moved` finds in one and in all motions."""
    animation = gltf.Animation(name=name, channels=[], samplers=[])
    seconds = ((motion.codes - motion.codes[0]) / motion.fps).astype(np.float32)
    times = cache(lambda step: writer.accessor(seconds[::step]))

    def animate(node: int, path: str, values: np.ndarray, still: bool) -> None:
        step = max(len(seconds) - 1, 1) if still else 1
        at, shown = times(step), values[::step].astype(np.float32)
        output = writer.accessor(shown.ravel() if path == "weights" else shown)
        animation.samplers.append(gltf.AnimationSampler(input=at, output=output, interpolation=gltf.ANIM_LINEAR))
        target = gltf.AnimationChannelTarget(node=node, path=path)
        animation.channels.append(gltf.AnimationChannel(sampler=len(animation.samplers) - 1, target=target))

    for joint, kind in np.argwhere(in_any).tolist():
        path, values = (("translation", motion.translations_m), ("rotation", motion.quaternions))[kind]
        animate(joint, path, values[:, joint], not in_this[joint, kind])
    if motion.shape_weights.size:
        weights = np.pad(motion.shape_weights, ((0, 0), (0, shapes - motion.shape_weights.shape[1])))
        animate(len(in_any), "weights", weights, not weights.any())
    return animation


def _moved(motion: JointMotion, skeleton: Skeleton) -> np.ndarray:
    """Return which joints leave their place and which their rotation at rest, (J, 2)."""
    rest = skeleton.local(skeleton.bind)
    turned = Rotation.from_matrix(rest[:, :3, :3]).as_quat()
    moved = np.zeros((len(rest), 2), bool)
    for joint in range(len(rest)):
        moved[joint, 0] = np.abs(motion.translations_m[:, joint] - rest[joint, :3, 3]).max() > STILL
        moved[joint, 1] = (1 - np.abs(motion.quaternions[:, joint] @ turned[joint])).max() > STILL**2 / 8
    return moved

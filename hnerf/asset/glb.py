"""Writer of glTF binary files: the skinned, textured, animated avatar in one file (glTF 2.0 specification, Khronos
Group)."""

from pathlib import Path

import cv2
import numpy as np
import pygltflib as gltf

from hnerf.asset.staging import StagedAvatar
from hnerf.body.descriptor import normals_of

COMPONENT_TYPES = {"float32": gltf.FLOAT, "uint16": gltf.UNSIGNED_SHORT, "uint32": gltf.UNSIGNED_INT}
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
        flat = values.reshape(len(values), -1)
        self.document.accessors.append(
            gltf.Accessor(
                bufferView=self.view(np.ascontiguousarray(values).tobytes(), target),
                componentType=COMPONENT_TYPES[values.dtype.name],
                count=len(values),
                type=SHAPES[values.shape[1:]],
                min=flat.min(0).tolist(),
                max=flat.max(0).tolist(),
            )
        )
        return len(self.document.accessors) - 1

    def save(self, path: Path) -> None:
        """Write the document to a file."""
        self.document.buffers[0].byteLength = len(self._chunk)
        self.document.set_binary_blob(bytes(self._chunk))
        self.document.save_binary(path)


def write_glb(path: Path, avatar: StagedAvatar, fps: float) -> None:
    """Write `avatar.glb`: joints are nodes 0 to J-1 in the rig's order, the mesh is node J; time 0 is the first
    frame."""
    writer = GlbWriter()
    document = writer.document
    _add_joints(document, avatar)
    document.materials.append(_material(writer, avatar.texture))
    no_weights = [0.0] * len(avatar.shapes_m)
    document.meshes.append(gltf.Mesh(primitives=[_primitive(writer, avatar)], weights=no_weights or None))
    inverse_bind = np.tile(np.eye(4, dtype=np.float32), (len(avatar.parents), 1, 1))
    inverse_bind[:, 3, :3] = -avatar.rest_joints_m  # matrices are stored by columns
    joints = list(range(len(avatar.parents)))
    document.skins.append(gltf.Skin(inverseBindMatrices=writer.accessor(inverse_bind), joints=joints, skeleton=0))
    document.nodes.append(gltf.Node(name="Surface", mesh=0, skin=0))
    document.scenes[0].nodes = [j for j in joints if avatar.parents[j] < 0] + [len(joints)]
    document.animations.append(_animation(writer, avatar, fps))
    writer.save(path)


def _add_joints(document: gltf.GLTF2, avatar: StagedAvatar) -> None:
    for name, offset_m in zip(avatar.joint_names, avatar.rest_offsets_m, strict=True):
        document.nodes.append(gltf.Node(name=name, translation=offset_m.tolist(), children=[]))
    for joint, parent in enumerate(avatar.parents):
        if parent >= 0:
            document.nodes[parent].children.append(joint)


def _primitive(writer: GlbWriter, avatar: StagedAvatar) -> gltf.Primitive:
    """Add the mesh and its correctives, with vertices split at the texture's seams; skin influences beyond four go into
    a second set."""
    vertex = np.zeros(len(avatar.uvs), np.int64)
    vertex[avatar.face_uvs] = avatar.faces
    normals = normals_of(avatar.rest_points_m, avatar.faces)
    attributes = gltf.Attributes(
        POSITION=_vertex_data(writer, avatar.rest_points_m[vertex], np.float32),
        NORMAL=_vertex_data(writer, normals[vertex], np.float32),
        TEXCOORD_0=_vertex_data(writer, avatar.uvs * (1, -1) + (0, 1), np.float32),  # v runs down in glTF
    )
    missing = -avatar.skin_joints.shape[1] % 4
    joints, weights = (np.pad(a, ((0, 0), (0, missing)))[vertex] for a in (avatar.skin_joints, avatar.skin_weights))
    for start in range(0, joints.shape[1], 4):
        setattr(attributes, f"JOINTS_{start // 4}", _vertex_data(writer, joints[:, start : start + 4], np.uint16))
        setattr(attributes, f"WEIGHTS_{start // 4}", _vertex_data(writer, weights[:, start : start + 4], np.float32))
    indices = writer.accessor(avatar.face_uvs.astype(np.uint32).ravel(), gltf.ELEMENT_ARRAY_BUFFER)
    targets = [gltf.Attributes(POSITION=_vertex_data(writer, shape[vertex], np.float32)) for shape in avatar.shapes_m]
    return gltf.Primitive(attributes=attributes, indices=indices, material=0, targets=targets or None)


def _vertex_data(writer: GlbWriter, values: np.ndarray, dtype: type) -> int:
    return writer.accessor(values.astype(dtype), gltf.ARRAY_BUFFER)


def _material(writer: GlbWriter, texture: np.ndarray) -> gltf.Material:
    _, png = cv2.imencode(".png", cv2.cvtColor(texture, cv2.COLOR_RGB2BGR))
    writer.document.images.append(gltf.Image(bufferView=writer.view(png.tobytes()), mimeType="image/png"))
    writer.document.samplers.append(gltf.Sampler(wrapS=gltf.CLAMP_TO_EDGE, wrapT=gltf.CLAMP_TO_EDGE))
    writer.document.textures.append(gltf.Texture(source=0, sampler=0))
    matte = gltf.PbrMetallicRoughness(
        baseColorTexture=gltf.TextureInfo(index=0), metallicFactor=0.0, roughnessFactor=1.0
    )
    return gltf.Material(name="Captured", pbrMetallicRoughness=matte)


def _animation(writer: GlbWriter, avatar: StagedAvatar, fps: float) -> gltf.Animation:
    """Add the rotations of the joints that turn, the translation of the root, and the weights of the correctives."""
    animation = gltf.Animation(name="Motion", channels=[], samplers=[])
    times = writer.accessor(((avatar.frames - avatar.frames[0]) / fps).astype(np.float32))

    def animate(joint: int, path: str, values: np.ndarray) -> None:
        output = writer.accessor(values.astype(np.float32))
        animation.samplers.append(gltf.AnimationSampler(input=times, output=output, interpolation=gltf.ANIM_LINEAR))
        target = gltf.AnimationChannelTarget(node=joint, path=path)
        animation.channels.append(gltf.AnimationChannel(sampler=len(animation.samplers) - 1, target=target))

    for joint, parent in enumerate(avatar.parents):
        if parent < 0:
            animate(joint, "translation", avatar.translations_m[:, joint])
        if (np.abs(avatar.quaternions[:, joint, :3]) > 1e-7).any():
            animate(joint, "rotation", avatar.quaternions[:, joint])
    if len(avatar.shapes_m):
        animate(len(avatar.parents), "weights", avatar.shape_weights.ravel())
    return animation

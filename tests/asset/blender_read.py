"""Run by Blender in a folder: describe what it reads from `avatar.fbx` and `avatar_cache.abc` there, in `read.json`."""

import json
import sys
from pathlib import Path
from typing import Any

import bpy
from io_scene_fbx import parse_fbx


def y_up(at: Any) -> list[float]:
    return [at.x, at.z, -at.y]


def surfaces_m(frames: list[int]) -> list[list[list[float]]]:
    """Return the vertices of the only mesh in each frame, Y up."""
    (mesh,) = (thing for thing in bpy.data.objects if thing.type == "MESH")
    found = []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        posed = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get())
        found.append([y_up(posed.matrix_world @ vertex.co) for vertex in posed.to_mesh().vertices])
    return found


def keyed_frames() -> list[float]:
    """Return the frames of all keys, in order."""
    bags = [bag for action in bpy.data.actions for bag in action.layers[0].strips[0].channelbags]
    return sorted({key.co[0] for bag in bags for curve in bag.fcurves for key in curve.keyframe_points})


def properties(element: Any, found: dict[str, Any]) -> dict[str, Any]:
    """Add the properties below an element of FBX, by name; those of objects follow their defaults."""
    if element.id == b"P":
        found[element.props[0].decode()] = element.props[-1]
    for below in element.elems:
        properties(below, found)
    return found


frames, fps = [3, 5, 8], float(sys.argv[-1])
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.fbx_import(filepath="avatar.fbx", anim_offset=0)
scene = bpy.context.scene
(armature,), (mesh,) = bpy.data.armatures, bpy.data.meshes
(shown,) = mesh.materials
(colour,) = (node for node in shown.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
skinned = next(thing for thing in scene.objects if thing.type == "MESH")
stated = properties(parse_fbx.parse("avatar.fbx")[0], {})
fbx = {
    "stated": {name: stated[name] for name in ("UpAxis", "UnitScaleFactor", "SpecularFactor")},
    "fps": scene.render.fps / scene.render.fps_base,
    "keys": keyed_frames(),
    "bones": {bone.name: [bone.parent and bone.parent.name, list(bone.head_local)] for bone in armature.bones},
    "groups": [group.name for group in skinned.vertex_groups],
    "shapes": [key.name for key in mesh.shape_keys.key_blocks],
    "colours": len(mesh.color_attributes),
    "texture": list(colour.inputs["Base Color"].links[0].from_node.image.size),
    "embedded": [image.packed_file is not None for image in bpy.data.images],
    "scale": list(skinned.matrix_world.to_scale()),
    "sides": len(mesh.polygons),
    "points_m": surfaces_m(frames),
}
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps, bpy.context.scene.render.fps_base = round(fps), round(fps) / fps
bpy.ops.wm.alembic_import(filepath=str(Path("avatar_cache.abc").resolve()))
scene = bpy.context.scene
abc = {"range": [scene.frame_start, scene.frame_end], "points_m": surfaces_m(frames)}
abc["uvs"] = len(bpy.data.meshes[0].uv_layers)
Path("read.json").write_text(json.dumps({"fbx": fbx, "abc": abc}))

"""A script for Blender, or for a Python that has its module bpy. `hnerf.asset.blender` starts it; nothing imports it.

From `avatar.usdz` and `avatar_cache.usdz` in the current folder, it makes `avatar.fbx` and `avatar_cache.abc` there.
The capture's frame rate follows `--`. Without it, the script only checks that this Blender has what is needed.
"""

import sys

import bpy
from bpy_extras.node_shader_utils import PrincipledBSDFWrapper

OLDEST = (4, 5)  # that was tried


def require_importers() -> None:
    """Raise RuntimeError if this Blender is too old, or was built without USD or Alembic, as by some distributions."""
    missing = [name for name in ("usd", "alembic") if not getattr(bpy.app.build_options, name)]
    if bpy.app.version < OLDEST or missing:
        without = f" without {' and '.join(missing)}" if missing else ""
        raise RuntimeError(f"it is Blender {bpy.app.version_string}{without}")


def read(file: str, fps: float) -> None:
    """Replace the scene by a USD file, and select its armature and mesh. Blender does not read the frame rate of the
    file."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=file, import_cameras=False, import_textures_mode="IMPORT_PACK")
    render = bpy.context.scene.render
    render.fps = max(1, round(fps))
    render.fps_base = render.fps / fps
    for thing in bpy.context.scene.objects:
        thing.select_set(thing.type in ("ARMATURE", "MESH"))


def main(fps: float) -> None:
    """Write both files."""
    read("avatar_cache.usdz", fps)
    captured = bpy.context.scene.frame_start, bpy.context.scene.frame_end
    bpy.ops.wm.alembic_export(filepath="avatar_cache.abc", start=captured[0], end=captured[1], selected=True)
    read("avatar.usdz", fps)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = captured  # other motions may last longer
    for material in bpy.data.materials:
        PrincipledBSDFWrapper(material, is_readonly=False).specular = 0.0  # FBX has no index of refraction, of 1 in USD
    bpy.ops.export_scene.fbx(
        filepath="/proc/self/cwd/avatar.fbx",  # FBX stores the absolute path, in which there may be the user's name
        use_selection=True,
        apply_scale_options="FBX_SCALE_UNITS",  # metres, instead of objects that are scaled by 100
        colors_type="NONE",  # vertex colours, by which some programs multiply the texture
        add_leaf_bones=False,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        bake_anim_simplify_factor=0.0,
        path_mode="COPY",
        embed_textures=True,
    )


if __name__ == "__main__":
    require_importers()
    for rate in sys.argv[sys.argv.index("--") + 1 :]:
        main(float(rate))

from pathlib import Path

import cv2
import numpy as np
import pygltflib
import trimesh

from hnerf.asset.compact_glb import compact_glb, read_glb
from hnerf.asset.glb import write_glb
from hnerf.asset.staging import StagedAvatar
from tests.asset.figure import INFO
from tests.asset.test_glb import accessor


def test_compacting_changes_only_the_texture_and_blend_shapes(staged: StagedAvatar, tmp_path: Path) -> None:
    """Blend shapes change by at most half a quantisation step: 1 / 65 536 m, and 1 / 256 for normals."""
    write_glb(tmp_path / "avatar.glb", staged, staged.rigs["full"], INFO)
    (tmp_path / "compact.glb").write_bytes(compact_glb((tmp_path / "avatar.glb").read_bytes(), 32))
    before, after = (pygltflib.GLTF2.load(str(tmp_path / name)) for name in ("avatar.glb", "compact.glb"))
    assert len(before.accessors) == len(after.accessors)
    floats = [i for i, item in enumerate(before.accessors) if item.componentType == pygltflib.FLOAT]
    shapes = before.meshes[0].primitives[0].targets
    places, turns = ({shape[name] for shape in shapes} for name in ("POSITION", "NORMAL"))
    assert places and turns
    for index in floats:
        half = 2.0**-16 if index in places else 2.0**-8 if index in turns else 0
        old, new = accessor(before, index), accessor(after, index)
        np.testing.assert_allclose(new, old, atol=half, rtol=0)
        assert not half or not np.any(new % (2 * half))
        if item := half and after.accessors[index]:
            assert (item.min, item.max) == (new.min(0).tolist(), new.max(0).tolist())
    (mesh,) = trimesh.load_scene(tmp_path / "compact.glb").geometry.values()
    assert mesh.visual.material.baseColorTexture.size == (32, 32)
    assert (after.images[0].mimeType, before.images[0].mimeType) == ("image/jpeg", "image/png")


def test_an_image_with_transparency_is_kept(staged: StagedAvatar, tmp_path: Path) -> None:
    write_glb(tmp_path / "avatar.glb", staged, staged.rigs["full"], INFO)
    document = pygltflib.GLTF2.load(str(tmp_path / "avatar.glb"))
    png = cv2.imencode(".png", np.full((8, 8, 4), 100, np.uint8))[1].tobytes()
    view = document.bufferViews[document.images[0].bufferView]
    view.byteOffset, view.byteLength = 0, len(png)
    document.set_binary_blob(png + document.binary_blob()[len(png) :])
    document.save_binary(tmp_path / "avatar.glb")
    compact, binary = read_glb(compact_glb((tmp_path / "avatar.glb").read_bytes(), 4))
    view = compact["bufferViews"][compact["images"][0]["bufferView"]]
    assert binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]] == png
    assert compact["images"][0]["mimeType"] == "image/png"

from pathlib import Path

import cv2
import numpy as np
import pygltflib
import trimesh

from hnerf.asset.compact_glb import compact_glb, read_glb
from hnerf.asset.staging import StagedAvatar
from tests.asset.pages import write_avatar
from tests.asset.test_glb import accessor


def test_only_the_texture_changes(staged: StagedAvatar, tmp_path: Path) -> None:
    write_avatar(tmp_path / "avatar.glb", staged)
    (tmp_path / "compact.glb").write_bytes(compact_glb((tmp_path / "avatar.glb").read_bytes(), 32))
    before, after = (pygltflib.GLTF2.load(str(tmp_path / name)) for name in ("avatar.glb", "compact.glb"))
    assert len(before.accessors) == len(after.accessors)
    floats = [i for i, item in enumerate(before.accessors) if item.componentType == pygltflib.FLOAT]
    for index in floats:
        np.testing.assert_array_equal(accessor(after, index), accessor(before, index))
    (mesh,) = trimesh.load_scene(tmp_path / "compact.glb").geometry.values()
    assert mesh.visual.material.baseColorTexture.size == (32, 32)
    assert (after.images[0].mimeType, before.images[0].mimeType) == ("image/jpeg", "image/png")


def test_an_image_with_transparency_is_kept(staged: StagedAvatar, tmp_path: Path) -> None:
    write_avatar(tmp_path / "avatar.glb", staged)
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

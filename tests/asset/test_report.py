import base64
import dataclasses
import io
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hnerf.asset import report
from hnerf.asset.albedo import Albedo
from hnerf.asset.baking import Filled
from hnerf.asset.comparison import Compared
from hnerf.asset.staging import StagedAvatar
from hnerf.evaluation.views import View


def grey(level: int, channels: int) -> np.ndarray:
    return np.full((64, 64, channels), level, np.uint8)


def test_every_picture_has_its_caption(staged: StagedAvatar, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Textures and renders are each of one grey level; the addresses of pictures are those of their first pixels."""
    monkeypatch.setattr(report, "STILLS", 2)
    monkeypatch.setattr(report, "TURNS", 3)
    monkeypatch.setattr("hnerf.evaluation.pictures.PICTURE_PX", (30, 40))
    monkeypatch.setattr("hnerf.evaluation.pictures.data_uri", lambda picture: str(picture[0, 0, 0]))
    assert staged.albedo is not None
    avatar = dataclasses.replace(staged, texture=grey(50, 3), albedo=Albedo(grey(60, 3), staged.albedo.light))
    levels = {"field": 10, "asset": 20, "albedo": 30, "splats": 40}
    renders = {name: grey(level, 4) for name, level in levels.items()}
    scores = {name: {"psnr": float(level)} for name, level in levels.items()}
    compared = Compared(View("novel_view", "01", 4), grey(5, 3), renders, scores)
    filled = Filled(grey(70, 1)[..., 0], 0.125)
    report.write_report(
        tmp_path / "report.html", "ada", avatar, filled, 3, np.eye(4), [compared], [], {"viewer": "none"}
    )
    page = (tmp_path / "report.html").read_text()
    shown = {caption: int(level) for level, caption in re.findall(r'<img src="(\d+)" alt="([^"]*)"', page)}
    light = "Estimated light, +Z in the middle, +X left of it"
    turntable, surface = ["0°", "180°"], ["Clay, front", "Clay, back", "Wireframe, front", "Wireframe, back"]
    rigs = ["Full rig, 3 joints", "Game rig, 3 joints"]
    assert list(shown)[:9] == [*turntable, *surface, "lod1, 400 triangles", *rigs]
    assert {caption: level for caption, level in list(shown.items())[9:] if caption not in ("Layout", light)} == {
        "Photograph, camera 01, frame 4": 5, "Field, 10.0 dB": 10, "Captured look, 20.0 dB": 20,
        "Albedo in its light, 30.0 dB": 30, "Splats, 40.0 dB": 40, "Texture": 50, "Albedo": 60,
        "White: the 12.5% of texels that no photograph shows, filled by the field": 70,
    }  # fmt: skip
    assert {"Layout", light} <= shown.keys()
    found = re.search(r'srcset="255">\s*<img src="data:image/webp;base64,([^"]*)" alt="The avatar, turning">', page)
    assert found is not None  # whoever asked for less motion sees the first still
    with Image.open(io.BytesIO(base64.b64decode(found[1]))) as moving:
        assert (getattr(moving, "n_frames", 1), moving.size) == (3, (21, 28))

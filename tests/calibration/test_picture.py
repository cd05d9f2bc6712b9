import dataclasses
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hnerf.calibration import picture
from hnerf.calibration.picture import _draw_scene, draw_cameras
from hnerf.geometry.axes import Y_UP_FROM_Z_UP
from tests.calibration.synthetic import STANDING_M, ring


@pytest.mark.parametrize("up", ["z", "y"])
def test_the_view_from_above_is_not_mirrored(up: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ring goes counter-clockwise about the vertical, whichever axis that is; from below it would be mirrored."""
    drawn = list[Axes]()
    monkeypatch.setattr(picture, "_draw_scene", lambda *given: drawn.append(given[0]) or _draw_scene(*given))
    cameras = [dataclasses.replace(c, R=c.R @ Y_UP_FROM_Z_UP.T) if up == "y" else c for c in ring(4)]
    draw_cameras(tmp_path / "cameras.png", cameras, dict.fromkeys((c.name for c in cameras), "ok"), up, None, None)
    above = drawn[0]
    x, y = above.transData.transform([text.xy for text in above.texts]).T
    assert (np.diff(np.unwrap(np.arctan2(y - y.mean(), x - x.mean()))) > 0).all()


def test_several_cameras_without_keypoints_are_not_labelled_as_one_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    labels = []
    monkeypatch.setattr(Axes, "text", lambda _, x, y, text, **__: labels.append(text))
    status = {"c0": "ok", "c1": "ok", "c2": "unjudged"}
    draw_cameras(tmp_path / "cameras.png", ring(3), status, "z", None, None)
    draw_cameras(tmp_path / "cameras.png", ring(3), {**status, "c1": "unjudged"}, "z", None, None)
    assert labels == ["no keypoints: no residuals", "one camera: no residuals"]


def test_a_camera_at_the_origin_is_drawn() -> None:
    """Its frustum extends 0.15 of the 4 m to the person along rays to corners 499.5 px off, at 1000 px focal length."""
    camera = dataclasses.replace(ring(1)[0], R=np.eye(3), t_m=np.zeros(3))
    axes = Figure().subplots()
    _draw_scene(axes, [camera], {"c0": "ok"}, np.full((1, *STANDING_M.shape), [0.0, 0, 4]), (0, 2))
    depths_m = [np.asarray(line.get_ydata()).max() for line in axes.lines[-4:]]
    assert depths_m == pytest.approx([0.6 / np.sqrt(1 + 2 * 0.4995**2)] * 4)

from pathlib import Path

import numpy as np
import pytest
import trimesh

from hnerf.evaluation import pictures
from hnerf.evaluation.galleries import Row, surface_row, view_row
from hnerf.evaluation.ground_truth import GroundTruth
from hnerf.evaluation.views import View
from tests.evaluation.ball import (
    PHOTOGRAPHED,
    RENDERED,
    ball_fit,
    ball_inputs,
    ball_mask,
    centre_m,
    write_ball_capture,
    write_ball_truth,
)


def levels(row: Row, *places: tuple[float, float]) -> dict[str, list[int]]:
    """Return the brightest channel of each picture, by caption, at places given as shares of its height and width."""
    found = {}
    for caption, picture in ((one.caption, np.array(one.uri)) for one in row.pictures):
        at = [tuple(int(share * side) for share, side in zip(place, picture.shape, strict=False)) for place in places]
        found[caption] = [int(picture[y, x].max()) for y, x in at]
    return found


@pytest.fixture(autouse=True)
def small_plain_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw small pictures, and leave them as arrays, so that tests can look at them."""
    monkeypatch.setattr(pictures, "PICTURE_PX", (75, 100))
    monkeypatch.setattr(pictures, "data_uri", lambda picture: picture)


def test_pictures_of_a_view_are_what_their_captions_say(tmp_path: Path) -> None:
    """The ball of 153 in front of 60 is rendered as 102 and, tracked, as 51. Its body is drawn over it: 0.45 x 153 +
    0.55 x 255. Its surroundings are dimmed to a fifth."""
    capture = write_ball_capture(tmp_path)
    write_ball_truth(capture, None)
    ball = ball_mask(capture.cameras["c"], centre_m(0))
    rendered = ball[..., None] * np.array([RENDERED] * 3 + [255], np.uint8)
    view, truth, inputs = View("novel_view", "c", 0), GroundTruth(tmp_path, capture), ball_inputs(capture)
    row = view_row(view, rendered, inputs, truth, "", ball_fit(), {"Tracked": rendered // 2})
    found = levels(row, (0.5, 0.5), (0, 0))
    assert list(found) == ["Input", "Mask", "Fitted body", "Render", "Ground truth", "Error", "Tracked"]
    assert found["Input"] == [PHOTOGRAPHED, 60] and found["Mask"] == [PHOTOGRAPHED, 12]
    assert found["Fitted body"] == pytest.approx([209, 60], abs=3)
    assert found["Render"] == [RENDERED, 0] and found["Ground truth"] == [PHOTOGRAPHED, 0]
    assert found["Error"][0] > 200 > 10 > found["Error"][1] and found["Tracked"] == [RENDERED // 2, 0]


def test_pictures_of_a_surface_are_what_their_captions_say() -> None:
    """The true ball, 13 cm in radius, fills 94 % of the width; the other one, of 10 cm, is 3 cm off, which is dark
    red."""
    ball, truth = (trimesh.creation.icosphere(3, radius_m) for radius_m in (0.1, 0.1 + pictures.FULL_DISTANCE_M))
    found = levels(surface_row(0, ball, truth, np.eye(4), ""), (0.5, 0.5), (0.5, 0.9))
    for side in ("front", "back"):
        assert found[f"Surface, {side}"][0] > 180 and found[f"Surface, {side}"][1] == 255
        assert found[f"Ground truth, {side}"][0] > 180 and found[f"Ground truth, {side}"][1] < 255
        assert found[f"Distance, {side}"][0] < 130 and found[f"Distance, {side}"][1] == 255


def test_the_front_is_seen_from_ahead_and_the_back_from_behind() -> None:
    """The body faces -Y. A large ball and a small one to its left, at +X, are seen on the left and on the right from
    ahead, and the other way round from behind. Above their middles, there is only the large one."""
    large, small = (trimesh.creation.icosphere(3, radius_m) for radius_m in (0.1, 0.04))
    both = trimesh.util.concatenate(large, small.apply_translation([0.3, 0, 0]))
    found = levels(surface_row(0, both, None, np.eye(4), ""), (0.4, 0.22), (0.4, 0.78))
    assert found["Surface, front"][0] < 255 == found["Surface, front"][1]
    assert found["Surface, back"][1] < 255 == found["Surface, back"][0]

"""Cameras fitted to the exact outlines of a box that stands in several places."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hnerf.calibration import outline_adjustment, silhouettes
from hnerf.calibration.outline_adjustment import _turned, _zoomed_about, adjust_to_outlines, follow_outlines
from hnerf.calibration.silhouettes import MaskOutline, Outlines
from hnerf.geometry.camera import Camera
from tests.calibration.synthetic import detections, ring, turned
from tests.calibration.test_refine import refined, with_c2
from tests.calibration.test_silhouettes import CORNERS_M, mask

MIDDLE_M = np.array([0.0, 0.0, 0.9])


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outline_adjustment, "EVALUATIONS", 12)
    monkeypatch.setattr(silhouettes, "POINTS", 24)


def places(range_m: float = 0.1) -> list[np.ndarray]:
    """Return the corners of the box, turned about the vertical and moved, at four instants."""
    turns = [np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) for a in np.arange(4) * 0.7]
    return [CORNERS_M @ turn.T + [range_m * np.sin(i), range_m * np.cos(2 * i), 0] for i, turn in enumerate(turns)]


@cache
def outlines(range_m: float = 0.1) -> Outlines:
    seen_m = places(range_m)
    by_camera = {c.name: [MaskOutline.around(mask(c, corners_m)) for corners_m in seen_m] for c in ring(4)}
    return Outlines(by_camera, tuple(range(4)))


def off_px(cameras: list[Camera]) -> np.ndarray:
    """Return the mean distance (C,) of the boxes' corners in each image from where the true camera sees them."""
    corners_m = np.concatenate(places())
    pairs = zip(cameras, ring(4), strict=True)
    return np.array(
        [np.linalg.norm(c.project(corners_m)[0] - t.project(corners_m)[0], axis=1).mean() for c, t in pairs]
    )


def test_a_camera_turns_about_the_person_and_moves_in_its_own_axes() -> None:
    """A quarter turn about the line of sight leaves the pivot at its pixel; a move by 1 cm to the right, 3.5 m away,
    shifts it by 1000 x 0.01 / 3.5 pixels."""
    camera = ring(4)[1]
    seen, depth_m = camera.project(MIDDLE_M)
    quarter = _turned(camera, np.array([0, 0, np.pi / 2, 0, 0, 0]), MIDDLE_M)
    np.testing.assert_allclose(quarter.project(MIDDLE_M)[0], seen, atol=1e-9)
    np.testing.assert_allclose(quarter.R, np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ camera.R, atol=1e-12)
    moved = _turned(camera, np.array([0, 0, 0, 0.01, 0, 0]), MIDDLE_M)
    np.testing.assert_allclose(moved.project(MIDDLE_M)[0] - seen, [camera.K[0, 0] * 0.01 / depth_m, 0], atol=1e-9)


def test_outlines_recover_a_turned_camera() -> None:
    given = with_c2(lambda c: turned(c, 0.5))
    found = adjust_to_outlines(outlines(), given, ["c2"], MIDDLE_M)
    assert [new is old for new, old in zip(found, given, strict=True)] == [True, True, False, True]
    assert off_px(given)[2] > 8 and off_px(found)[2] < 1


def test_fitting_all_cameras_keeps_the_world_in_place() -> None:
    given = with_c2(lambda c: turned(c, 0.5))
    found = adjust_to_outlines(outlines(), given, [c.name for c in given], MIDDLE_M)
    assert off_px(found).max() < off_px(given).max() / 2
    assert outlines().cost_px(found) < outlines().cost_px(given) / 2
    assert max(np.linalg.norm(new.centre_m - old.centre_m) for new, old in zip(found, given, strict=True)) < 0.1
    moved_m = np.mean([new.centre_m - old.centre_m for new, old in zip(found, given, strict=True)], axis=0)
    np.testing.assert_allclose(moved_m, 0, atol=1e-9)


def test_outlines_correct_keypoint_errors_that_are_the_same_in_all_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """c2 is turned by a degree, and its detector sees everything 4 px to the right: keypoints alone leave it 4 px off.
    If keypoints have no error, outlines change nothing."""
    monkeypatch.setattr(Outlines, "of", lambda *_: outlines())
    given = with_c2(lambda c: turned(c, 1.0))
    biased = detections(ring(4), 1)
    biased[2, ..., 0] += 4
    alone, both = (refined(tmp_path / name, given, biased, o) for name, o in (("a", None), ("b", outlines())))
    assert off_px(alone.cameras)[2] == pytest.approx(4, abs=0.5) and off_px(both.cameras)[2] < 1
    assert "; then fitted to outlines: those of held-out frames go from" in both.reasons["c2"]
    exact = refined(tmp_path / "c", given, detections(ring(4), 0), outlines())
    assert "outlines" not in exact.reasons["c2"] and off_px(exact.cameras)[2] < 0.1


def test_cameras_stay_if_no_fitted_instant_has_two_outlines() -> None:
    """Of two instants, the first is fitted; only one camera has an outline there."""
    seen = outlines().by_camera
    halves = Outlines({"c0": [None, seen["c0"][1]], "c1": list(seen["c1"][:2])}, (0, 1))
    given = ring(2)
    found, gain = follow_outlines(halves, given, ["c0", "c1"], np.tile(MIDDLE_M, (2, 25, 1)), 0.02)
    assert gain == "" and all(a is b for a, b in zip(found, given, strict=True))


def test_a_zoomed_camera_sees_the_person_at_the_same_place_and_size() -> None:
    """At twice the focal length and distance, a point 10 cm to the side of the pivot stays at its pixel. If it is also
    10 cm nearer to the camera, it is seen closer to the pivot, by the ratio of depths."""
    camera = ring(4)[1]
    beside_m, before_m = MIDDLE_M + 0.1 * camera.R[0], MIDDLE_M + 0.1 * camera.R[0] - 0.1 * camera.R[2]
    far = _zoomed_about(camera, 2.0, MIDDLE_M)
    assert far.K[0, 0] == far.K[1, 1] == 2000 and far.K[0, 2] == camera.K[0, 2]
    np.testing.assert_allclose(far.project(beside_m)[0], camera.project(beside_m)[0], atol=1e-9)
    depth_m = camera.project(MIDDLE_M)[1]
    seen_px = 1000 * 0.1 / depth_m * 2 * depth_m / (2 * depth_m - 0.1)
    assert far.project(before_m)[0][0] - camera.project(MIDDLE_M)[0][0] == pytest.approx(seen_px)


def test_outlines_recover_an_unknown_focal_length(monkeypatch: pytest.MonkeyPatch) -> None:
    """A box moves by a metre. Three cameras have a focal length that is a tenth too long and stand as much too far
    away; the focal length of the fourth is known."""
    monkeypatch.setattr(silhouettes, "POINTS", 48)
    monkeypatch.setattr(outline_adjustment, "EVALUATIONS", 8)
    given = [camera if camera.name == "c3" else _zoomed_about(camera, 1.1, MIDDLE_M) for camera in ring(4)]
    names = [camera.name for camera in given]
    found = adjust_to_outlines(outlines(0.5), given, names, MIDDLE_M, names[:3])
    assert [c.K[0, 0] for c in found[:3]] == pytest.approx([1000] * 3, rel=0.03)
    assert found[3].K[0, 0] == 1000

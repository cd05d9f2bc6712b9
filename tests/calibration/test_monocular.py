import dataclasses

import numpy as np
import pytest

from hnerf.calibration.monocular import ground_reasons, intrinsics_reasons, raised_above_ground
from hnerf.capture.ingest import ingest
from hnerf.capture.standing import is_standing, stature_on_ground_m
from hnerf.capture.subject import subject_keypoints
from hnerf.config import CaptureSettings
from tests.calibration.synthetic import STANDING_M, detections, look_at, ring
from tests.shared_data import shared_capture


def standing() -> np.ndarray:
    """Return the walk as the first camera of the ring sees it, without noise."""
    return detections(ring(1), noise_px=0)[0]


def test_plausible_intrinsics_give_no_reasons() -> None:
    assert intrinsics_reasons(ring(1)[0]) == []  # 1000 px wide at 1000 px focal length: 53 degrees


@pytest.mark.parametrize(
    ("K", "words"),
    [
        # 1000 px at 200 px focal length: 2 atan 2.5 = 136 degrees; at 8000 px: 7 degrees.
        ([[200, 0, 499.5], [0, 200, 499.5], [0, 0, 1]], "field of view 136 degrees"),
        ([[8000, 0, 499.5], [0, 8000, 499.5], [0, 0, 1]], "field of view 7 degrees"),
        # The middle of an image of 1920 x 1080.
        (
            [[1000, 0, 959.5], [0, 1000, 539.5], [0, 0, 1]],
            "principal point at 96 % of the width and 54 % of the height",
        ),
        ([[1000, 0, 499.5], [0, 1250, 499.5], [0, 0, 1]], "pixels 1.25 times as wide as high"),
    ],
)
def test_implausible_intrinsics_are_named(K: list, words: str) -> None:
    reasons = intrinsics_reasons(dataclasses.replace(ring(1)[0], K=np.array(K, float)))
    assert len(reasons) == 1 and words in reasons[0]


def test_stature_by_hand() -> None:
    # The figure's nose is at 1.64 m, its toes at 2 cm; the ray to a toe reaches the ground a little behind it.
    camera = ring(1)[0]
    assert stature_on_ground_m(camera, standing(), "z") == pytest.approx(STANDING_M[0, 2] / 0.92, abs=0.08)


def test_ankles_give_the_stature_if_no_foot_is_seen() -> None:
    """A person 2 m tall is seen from 4 m away: the ankles at a height of 0.039 x 2 m, the nose at 0.92 x 2 m."""
    camera = look_at("0", np.array([4.0, 0, 1.0]), target_m=np.array([0, 0, 1.0]))
    points_m = np.array([[0, 0, 1.84], [0, 0.1, 0.078], [0, -0.1, 0.078]])
    seen = np.zeros((1, 25, 3))
    seen[0, [0, 11, 14]] = np.column_stack([camera.project(points_m)[0], np.ones(3)])
    assert stature_on_ground_m(camera, seen, "z") == pytest.approx(2.0, rel=2e-3)  # ankles are a little to the side
    assert raised_above_ground(camera, seen, "z", 2.0) == (camera, "")
    thrice = np.repeat(seen, 3, 0)
    thrice[0, 19] = [*camera.project(np.array([[0, 0, 0.5]]))[0][0], 0.3]  # a toe where the knee is
    assert stature_on_ground_m(camera, thrice, "z") == pytest.approx(2.0, rel=2e-3)


def test_a_known_stature_decides_whether_height_0_is_the_ground() -> None:
    """The figure measures 1.78 m, 1.33 times the 1.34 m of a child."""
    camera = ring(1)[0]
    assert "not 1.34 m: height 0 is not the ground" in ground_reasons(camera, standing(), "z", 1.34)[0]
    assert "can be true" in ground_reasons(camera, standing(), "z", 1.8)[0]
    assert [is_standing(m, 1.0) for m in (0.84, 0.86, 1.19, 1.21, np.nan)] == [False, True, True, False, False]
    assert [is_standing(m, None) for m in (1.19, 1.21, 2.09, 2.11, np.nan)] == [False, True, True, False, False]


def test_a_wrong_ground_or_scale_is_flagged() -> None:
    camera = ring(1)[0]
    assert "can be true" in ground_reasons(camera, standing(), "z", None)[0]
    doubled = dataclasses.replace(camera, t_m=2 * camera.t_m)  # the camera twice as far, so the person twice as tall
    assert "would be 3.5" in ground_reasons(doubled, standing(), "z", None)[0]
    below = dataclasses.replace(camera, t_m=camera.t_m + camera.R @ [0, 0, 2.0])  # the camera two metres down
    assert "cannot be checked" in ground_reasons(below, standing(), "z", None)[0]


def test_a_camera_of_unknown_height_is_placed_by_a_known_stature() -> None:
    """A camera of the ring that is moved down to height 0 returns to its height; one whose height is known stays."""
    camera = ring(1)[0]
    vertical, height_m = np.array([0, 0, 1.0]), camera.centre_m[2]
    lowered = dataclasses.replace(camera, t_m=camera.t_m + camera.R @ vertical * height_m)
    raised, words = raised_above_ground(lowered, standing(), "z", stature_on_ground_m(camera, standing(), "z"))
    np.testing.assert_allclose(raised.centre_m, camera.centre_m, atol=1e-6)
    assert words.startswith(f"its height is not known: {height_m:.2f} m if")
    assert raised_above_ground(camera, standing(), "z", 1.7) == (camera, "")
    head_first = standing()
    head_first[:, 0, 1] = head_first[:, [19, 21, 22, 24], 1].max(1) + 100  # this would put the camera below the ground
    assert raised_above_ground(lowered, head_first, "z", 1.7)[0] is lowered


def test_the_rendered_performer_stands_on_the_ground(tmp_path_factory: pytest.TempPathFactory) -> None:
    capture = ingest(shared_capture("valid-turn-mono"), CaptureSettings(), tmp_path_factory.mktemp("mono"))
    name = capture.train_cameras[0]
    keypoints = subject_keypoints(capture)[name]
    assert stature_on_ground_m(capture.cameras[name], keypoints, capture.up) == pytest.approx(1.75, abs=0.2)


def test_soles_give_the_stature_if_they_are_seen_in_most_frames() -> None:
    """A toe stands on the ground in two of three frames; ankles are found in all of them, far too high."""
    camera = look_at("0", np.array([4.0, 0, 1.0]), target_m=np.array([0, 0, 1.0]))
    points_m = np.array([[0, 0, 1.84], [0, 0, 0.3], [0, 0, 0.3], [0, 0, 0]])
    seen = np.zeros((3, 25, 3))
    seen[:, [0, 11, 14, 19]] = np.column_stack([camera.project(points_m)[0], np.ones(4)])
    seen[2, 19] = 0
    assert stature_on_ground_m(camera, seen, "z") == pytest.approx(2.0)

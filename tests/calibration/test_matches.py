from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hnerf.calibration.matches import Matches, _match_features, _verified_matches, fundamental, sampson_px
from hnerf.capture.capture import Capture
from hnerf.geometry.camera import Camera
from tests.calibration.synthetic import look_at, turned


def pair() -> tuple[Camera, Camera]:
    """Return two cameras of 1000 px focal length, 30 degrees apart."""
    target_m = np.array([0, 0, 1.0])
    centre_m = 4 * np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0]) + target_m
    return look_at("a", np.array([4.0, 0, 1]), target_m), look_at("b", centre_m, target_m)


def seen(count: int = 200) -> np.ndarray:
    """Return points (n, 2, 2) in a cube of 2 m as both cameras see them."""
    points_m = np.random.default_rng(0).uniform([-1, -1, 0], [1, 1, 2], (count, 3))
    return np.stack([camera.project(points_m)[0] for camera in pair()], 1)


def test_sampson_by_hand() -> None:
    # Cameras side by side, F of a pure shift along x: matches must lie on one row. Two rows apart is a gradient of
    # sqrt(1 + 1) and a residual of 2: a distance of sqrt 2, shared between both images.
    F = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    assert sampson_px(F, np.array([[[5.0, 7], [9, 7]], [[5, 7], [9, 9]]])) == pytest.approx([0, np.sqrt(2)])


def test_matches_agree_with_true_cameras_but_not_with_a_turned_one() -> None:
    a, b = pair()
    assert sampson_px(fundamental(a, b), seen()).max() < 1e-8
    # A pitch of one degree is 17.5 px along y at the middle; shared between both images, 17.5 / sqrt 2 = 12.3.
    assert np.median(sampson_px(fundamental(a, turned(b, 1.0, axis=0)), seen())) == pytest.approx(12.3, abs=1)


def test_matches_are_verified_without_the_calibration() -> None:
    wrong = np.random.default_rng(1).uniform(0, 1000, (60, 2, 2))
    kept = _verified_matches(np.concatenate([seen(), wrong]))
    assert 200 <= len(kept) < 210
    assert len(_verified_matches(wrong)) == 0
    assert len(_verified_matches(seen(10))) == 0


def test_matches_use_integer_pixel_centres() -> None:
    """COLMAP puts the corner of an image at 0, and the centre of the first pixel at one half."""
    a, b = ([SimpleNamespace(x=x + 0.5, y=7.5) for x in places] for places in ((3, 9), (20, 21, 22)))
    matcher: Any = SimpleNamespace(match=lambda *_: [(1, 2), (0, 0)])
    found: Any = (a, None), (b, None)
    assert _match_features(matcher, *found).tolist() == [[[9, 7], [22, 7]], [[3, 7], [20, 7]]]


def test_views_a_right_angle_apart_share_no_matches(wave: Capture) -> None:
    found = Matches.of(wave)
    assert found.by_pair == {}
    assert found.residuals_px(list(wave.cameras.values())) == {}


def test_matches_of_which_most_are_wrong_are_not_used() -> None:
    """20 of 100 are right: enough in number, but less than 30 %."""
    wrong = np.random.default_rng(1).uniform(0, 1000, (80, 2, 2))
    assert len(_verified_matches(np.concatenate([seen(20), wrong]))) == 0

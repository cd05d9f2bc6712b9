import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hnerf.calibration.diagnosis import MISTAKES, SINGLE_CAMERA_MISTAKES, measure, undo_mistake
from hnerf.calibration.evidence import Evidence
from hnerf.calibration.matches import Matches
from hnerf.calibration.refine import Refinement, judge_by_outlines, refine
from hnerf.config import CalibrationSettings
from hnerf.geometry.camera import Camera
from tests.calibration.synthetic import detections, ring, true_error_px, turned, walk_m, write_capture

SETTINGS = CalibrationSettings()
NO_MATCHES = Matches({}, 0)

pytestmark = pytest.mark.usefixtures("no_pictures")


class OutlinesCosting:
    """Stand-in for the outlines of one instant: one cost for the given cameras, another for any refined ones."""

    instants = (0,)

    def __init__(self, given: Sequence[Camera], given_px: float, refined_px: float) -> None:
        self.given, self.given_px, self.refined_px = given, given_px, refined_px

    def cost_px(self, cameras: Sequence[Camera]) -> float:
        return self.given_px if cameras is self.given else self.refined_px


def refined(
    root: Path, cameras: list[Camera], keypoints: np.ndarray, outlines: Any = None, matches: Matches = NO_MATCHES
) -> Refinement:
    evidence = Evidence(write_capture(root, cameras, keypoints), keypoints, outlines, matches, None)
    return refine(evidence, cameras, SETTINGS)


def with_c2(change: Any) -> list[Camera]:
    return [change(camera) if camera.name == "c2" else camera for camera in ring(4)]


@pytest.mark.parametrize(("after_px", "accepted"), [(0.1, True), (0.54, True), (0.6, False)])
def test_refined_cameras_are_rejected_if_outlines_fit_worse(tmp_path: Path, after_px: float, accepted: bool) -> None:
    given = with_c2(lambda c: turned(c, 1.0))
    found = refined(tmp_path, given, detections(ring(4), 1), OutlinesCosting(given, 0.5, after_px))
    assert [new is not old for new, old in zip(found.cameras, given, strict=True)] == [False, False, accepted, False]
    assert found.outlines_px == {"as given": 0.5, "refined": after_px}
    assert any("outlines fit worse, from 0.50 to 0.60 px" in note for note in found.notes) != accepted
    assert found.reasons["c2"].startswith("pose refined" if accepted else "pose kept")


@pytest.mark.parametrize(("after_px", "accepted"), [(0.039, True), (0.06, False)])
def test_outlines_may_lose_no_larger_a_share_than_keypoints_gain(after_px: float, accepted: bool) -> None:
    """Keypoints improve by a third, so the outlines' cost may rise by a third, from .03 to .04 px."""
    given, changed = ring(4), with_c2(lambda c: turned(c, 1.0))
    _, refusal = judge_by_outlines(OutlinesCosting(given, 0.03, after_px), given, changed, 1 / 3)  # type: ignore[arg-type]
    assert (refusal == "") == accepted


@pytest.mark.parametrize("as_given", [True, False])
def test_matches_can_prevent_refinement(tmp_path: Path, as_given: bool) -> None:
    """c2 is turned by a degree. Matches that agree with the turned camera keep it; those of the true camera let it be
    refined."""
    given, points_m = with_c2(lambda c: turned(c, 1.0)), walk_m().reshape(-1, 3)[:40]
    seen = [camera.project(points_m)[0] for camera in (given if as_given else ring(4))[1:3]]
    found = refined(tmp_path, given, detections(ring(4), 1), matches=Matches({("c1", "c2"): np.stack(seen, 1)}, 0))
    assert (found.cameras[2] is given[2]) == as_given
    assert ("but matches of c1 and c2 go from 0.00 to" in found.reasons["c2"]) == as_given


def test_constant_detector_bias_moves_no_camera(tmp_path: Path) -> None:
    # Each joint is detected 4 px off, in every frame alike: judged by held-out frames alone, refining would seem right.
    bias = 4 * np.random.default_rng(3).normal(size=(4, 1, 25, 2))
    given, keypoints = ring(4), detections(ring(4), 1)
    keypoints[..., :2] += bias
    assert refined(tmp_path, given, keypoints).cameras is given


def test_a_wrong_focal_length_is_refined_if_the_pose_does_not_suffice(tmp_path: Path) -> None:
    # The figure walks 0.4 m to and fro, 3.5 m from the camera: no distance imitates a focal length that is off by 1/5.
    zoom = np.array([[1.2, 1, 1], [1, 1.2, 1], [1, 1, 1]])
    found = refined(tmp_path, with_c2(lambda c: dataclasses.replace(c, K=c.K * zoom)), detections(ring(4), 1))
    assert found.reasons["c2"].startswith("pose and focal length refined")
    assert found.cameras[2].K[0, 0] == pytest.approx(1000, rel=0.02)
    assert found.cameras[2].K[0, 0] == found.cameras[2].K[1, 1]
    assert found.cameras[2].K[0, 2] == 499.5
    assert true_error_px(found.cameras[2], ring(4)[2]) < 1


def test_one_frame_is_enough_to_refine_a_camera(tmp_path: Path) -> None:
    given = with_c2(lambda c: turned(c, 2.0))
    found = refined(tmp_path, given, detections(ring(4), 1)[:, :1])
    assert [new is not old for new, old in zip(found.cameras, given, strict=True)] == [False, False, True, False]


def test_two_wrong_cameras_are_refined_and_the_others_kept(tmp_path: Path) -> None:
    given = [turned(c, 1.0, axis=i) if i < 2 else c for i, c in enumerate(ring(4))]
    found = refined(tmp_path, given, detections(ring(4), 1))
    assert [new is not old for new, old in zip(found.cameras, given, strict=True)] == [True, True, False, False]
    assert all(true_error_px(new, true) < 1 for new, true in zip(found.cameras, ring(4), strict=True))


def test_one_wrong_camera_among_six_is_found(tmp_path: Path) -> None:
    given = [turned(camera, 0.5) if camera.name == "c5" else camera for camera in ring(6)]
    found = refined(tmp_path, given, detections(ring(6), 2)[:, ::2])
    assert [camera.name for camera, old in zip(found.cameras, given, strict=True) if camera is not old] == ["c5"]


def test_with_two_cameras_neither_is_refined(tmp_path: Path) -> None:
    given = ring(4)[:2]
    found = refined(tmp_path, given, detections(ring(4), 1)[:2])
    assert found.cameras is given
    assert set(found.reasons.values()) == {"pose kept: refining it needs two other cameras"}


@pytest.mark.parametrize("cause", [*MISTAKES, *SINGLE_CAMERA_MISTAKES])
def test_a_known_mistake_in_one_camera_is_undone(cause: str) -> None:
    make = dict(MISTAKES)
    make["T is the camera's centre"] = lambda c: dataclasses.replace(c, t_m=c.centre_m)
    make |= {
        "T is in millimetres": lambda c: dataclasses.replace(c, t_m=1e3 * c.t_m),
        "T is in centimetres": lambda c: dataclasses.replace(c, t_m=1e2 * c.t_m),
        "T is in inches": lambda c: dataclasses.replace(c, t_m=c.t_m / 0.0254),
        "T is in metres declared as millimetres": lambda c: dataclasses.replace(c, t_m=1e-3 * c.t_m),
    }
    given, keypoints = with_c2(make[cause]), detections(ring(4), 1)
    cameras, causes = undo_mistake(given, keypoints, measure(given, keypoints))
    assert causes == {"c2": cause}
    np.testing.assert_allclose(cameras[2].projection, ring(4)[2].projection, atol=1e-9)


def test_a_camera_far_off_for_no_known_reason_is_left_to_refinement() -> None:
    given, keypoints = with_c2(lambda c: turned(c, 20.0)), detections(ring(4), 1)
    assert undo_mistake(given, keypoints, measure(given, keypoints)) == (given, {})

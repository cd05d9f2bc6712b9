"""Cameras calibrated from the person: rig, lenses, vertical and scale compared with known cameras, and refusals."""

import dataclasses
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from hnerf.calibration.bundle import align, undistort
from hnerf.calibration.person import calibrate, rig
from hnerf.calibration.person.calibrate import (
    PersonCalibration,
    Uncertainty,
    _check_uncertainty,
    calibrate_from_person,
)
from hnerf.calibration.person.lens import fit_lenses
from hnerf.calibration.person.rig import first_poses
from hnerf.calibration.person.upright import scale_to, stand_on_ground
from hnerf.calibration.silhouettes import Outlines
from hnerf.capture.capture import SubjectPoint
from hnerf.capture.formats.easymocap import EasyMocap
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera
from tests.calibration.synthetic import STANDING_M, detections, look_at, ring, turned, walk_m, write_capture

pytestmark = pytest.mark.usefixtures("no_pictures")

STATURE_M = 1.56 / 0.87  # of the figure: its limb chain, divided by the chain's share of an adult's stature


def without_poses(cameras: list[Camera]) -> list[Camera]:
    return [dataclasses.replace(camera, R=np.eye(3), t_m=np.zeros(3)) for camera in cameras]


def calibrated(root: Path, truth: list[Camera], keypoints: np.ndarray, unknown: list[str]) -> PersonCalibration:
    """Calibrate a recording of these keypoints. unknown: cameras whose focal length is not known."""
    capture = write_capture(root, without_poses(truth), keypoints)
    return calibrate_from_person(capture, unknown, dict.fromkeys(capture.cameras, "given"), STATURE_M)


def worst_errors(cameras: list[Camera], truth: list[Camera]) -> tuple[float, float]:
    """Return the largest turn in degrees and move in metres, after a similarity alignment."""
    aligned = align(cameras, truth)
    turns = [np.linalg.norm(cv2.Rodrigues(a.R @ b.R.T)[0]) for a, b in zip(aligned, truth, strict=True)]
    moves = [np.linalg.norm(a.centre_m - b.centre_m) for a, b in zip(aligned, truth, strict=True)]
    return float(np.rad2deg(max(turns))), float(max(moves))


def test_a_rig_is_found_without_poses() -> None:
    truth = ring(4)
    turn_deg, move_m = worst_errors(first_poses(without_poses(truth), detections(truth, 0.5)), truth)
    assert turn_deg < 0.1 and move_m < 0.01


def test_a_rig_of_cameras_far_from_the_person_is_found() -> None:
    """At 300 m the person is so small an angle that SQPnP, which adds the third and fourth camera, refuses it."""
    middle_m, K = np.array([0, 0, 0.9]), np.array([[85e3, 0, 499.5], [0, 85e3, 499.5], [0, 0, 1]])
    places_m = [(camera.name, middle_m + 85 * (camera.centre_m - middle_m)) for camera in ring(4)]
    far = [dataclasses.replace(look_at(name, place_m, middle_m), K=K) for name, place_m in places_m]
    turn_deg, move_m = worst_errors(first_poses(without_poses(far), detections(far, 0.5)), far)
    assert turn_deg < 0.1 and move_m < 0.01 * 300


def test_a_camera_that_sees_the_person_for_a_moment_is_added(monkeypatch: pytest.MonkeyPatch) -> None:
    """One of the three frames of the start is among the four that c3 shares with the others: 25 of the 50 keypoints
    that it takes."""
    monkeypatch.setattr(rig, "START_FRAMES", 3)
    truth = ring(4)
    keypoints = detections(truth, 0.5)
    keypoints[3, 4:, :, 2] = 0
    turn_deg, move_m = worst_errors(first_poses(without_poses(truth), keypoints), truth)
    assert turn_deg < 0.3 and move_m < 0.03


def test_a_pair_with_a_wrong_pose_does_not_end_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most keypoints seem to fit the pair, but no other camera fits the points that it triangulates."""
    truth, found = ring(4), rig._relative_pose

    def misleading(a: Camera, b: Camera, keypoints: np.ndarray, inlier_px: float) -> rig._Pair | None:
        pair = found(a, b, keypoints, inlier_px)
        if (a.name, b.name) != ("c0", "c1") or pair is None:
            return pair
        first, second = pair.cameras
        return rig._Pair((first, turned(second, 90, axis=1)), agreeing=10**6, angle_deg=60.0)

    monkeypatch.setattr(rig, "_relative_pose", misleading)
    turn_deg, move_m = worst_errors(first_poses(without_poses(truth), detections(truth, 0.5)), truth)
    assert turn_deg < 0.1 and move_m < 0.01


def test_a_common_focal_length_is_found_from_a_poor_guess() -> None:
    truth = ring(4)
    keypoints = detections(truth, 0.5)
    K = np.array([[750.0, 0, 499.5], [0, 750, 499.5], [0, 0, 1]])
    guess = [dataclasses.replace(camera, K=K) for camera in without_poses(truth)]
    fit, _ = fit_lenses(first_poses(guess, keypoints), keypoints, [c.name for c in truth], 0.02)
    assert fit.what == "one focal length"
    assert fit.cameras[0].K[0, 0] == pytest.approx(1000, rel=0.01)


def test_a_distortion_is_found_if_held_out_keypoints_show_it() -> None:
    truth = ring(4)
    keypoints = detections(truth, 0.3)
    for points, camera in zip(keypoints, truth, strict=True):
        rays = (points[..., :2] - camera.K[:2, 2]) / 1000
        points[..., :2] = 1000 * rays * (1 - 0.2 * (rays**2).sum(-1, keepdims=True)) + camera.K[:2, 2]
    names = [camera.name for camera in truth]
    fit, _ = fit_lenses(first_poses(without_poses(truth), keypoints), keypoints, names, 0.02)
    assert fit.what == "one focal length, one distortion"
    assert fit.k1 == pytest.approx(-0.2, abs=0.02)


def test_undistort_inverts_k1_by_hand() -> None:
    camera = Camera("a", np.diag([100.0, 100, 1]), np.eye(3), np.zeros(3), 100, 100)
    seen = np.array([[[100 * 0.5 * (1 + 0.1 * 0.25), 0, 1.0], [7, 7, 0]]])  # x = 0.5, r^2 = 0.25, k1 = 0.1
    straight = undistort(seen, [camera], ["a"], 0.1)
    assert straight[0, 0, 0] == pytest.approx(50, abs=0.01)
    assert straight[0, 1].tolist() == [7, 7, 0]


def test_the_height_sets_the_scale() -> None:
    cameras, points = scale_to(ring(3), 2 * walk_m(), STATURE_M)
    assert np.allclose(points, walk_m(), atol=1e-3)  # 1.56 m leaves out the limbs' thickness
    assert np.allclose(cameras[0].centre_m, ring(3)[0].centre_m / 2, atol=1e-3)


def test_the_ground_is_put_below_the_feet_in_any_world() -> None:
    tumble = cv2.Rodrigues(np.array([1.0, 2.0, 0.5]))[0]
    cameras = [
        dataclasses.replace(c, R=c.R @ tumble.T, t_m=c.t_m - c.R @ tumble.T @ np.array([1.0, 2, 3])) for c in ring(4)
    ]
    stood, _ = stand_on_ground(cameras, walk_m() @ tumble.T + [1, 2, 3], 1 / 30)
    assert stood[0].centre_m[0] == pytest.approx(0, abs=1e-9) and stood[0].centre_m[1] < 0
    heights_m = [camera.centre_m[2] + 0.02 for camera in stood]  # the toes are 2 cm above the floor
    assert heights_m == pytest.approx([camera.centre_m[2] for camera in ring(4)], abs=1e-6)


@pytest.mark.parametrize("roll_deg", [0.0, 90.0, -90.0])
def test_a_leaning_person_does_not_tilt_cameras_that_are_level_or_on_edge(roll_deg: float) -> None:
    lean = cv2.Rodrigues(np.array([0, np.deg2rad(20), 0]))[0]
    still = np.repeat((STANDING_M @ lean.T)[None], 12, axis=0)
    stood, up_sd_deg = stand_on_ground([turned(camera, roll_deg, axis=2) for camera in ring(4)], still, 1 / 30)
    assert max(abs(np.rad2deg(turned(camera, -roll_deg, axis=2).R[0, 2])) for camera in stood) < 3
    assert up_sd_deg > 2  # the person and the cameras disagree, so the vertical is uncertain


def test_frames_within_a_step_count_as_one_at_any_rate() -> None:
    """Doubling both frames and rate changes nothing. Frames half a second apart count as much as a second apart."""
    rolled = [dataclasses.replace(c, R=cv2.Rodrigues(np.array([0, 0, 0.1]))[0] @ c.R) for c in ring(4)]
    walk = walk_m() + np.random.default_rng(0).normal(0, 0.01, (12, 25, 3))
    once, twice, slow, slower = (
        stand_on_ground(rolled, points_m, frame_s)
        for points_m, frame_s in ((walk, 0.1), (walk.repeat(2, 0), 0.05), (walk, 0.5), (walk, 1.0))
    )
    assert twice[1] == pytest.approx(once[1]) and slower[1] == slow[1] < once[1]
    assert np.allclose(twice[0][0].R, once[0][0].R) and not np.allclose(slow[0][0].R, once[0][0].R)


def test_a_recording_gets_cameras_in_metres_with_an_uncertainty(tmp_path: Path) -> None:
    truth = ring(4)
    found = calibrated(tmp_path, truth, detections(truth, 1.0), [])
    turn_deg, move_m = worst_errors(found.cameras, truth)
    assert turn_deg < 0.3 and move_m < 0.02
    spread = [np.linalg.norm(a.centre_m - b.centre_m) for a, b in pairwise(found.cameras)]
    true = [np.linalg.norm(a.centre_m - b.centre_m) for a, b in pairwise(truth)]
    assert np.allclose(spread, true, rtol=0.02)
    assert all(0 < error.turn_deg < 1 and 0 < error.move_m < 0.05 for error in found.uncertainty.values())
    found.save(tmp_path / "out")
    read = EasyMocap(tmp_path / "out").lenses()
    assert np.allclose(read["c1"].R, found.cameras[1].R)


def test_poses_follow_outlines_before_scaling_and_grounding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Outlines turn c1 by half a degree, and it stays so in the rig that is scaled and put on the ground. The fit to
    outlines gets the names of cameras with unknown focal lengths."""
    truth = ring(4)

    def follow(outlines: str, cameras: list[Camera], *others: object) -> tuple[list[Camera], str]:
        assert outlines == "found" and others[-1] == ["c0"]
        return [turned(camera, 0.5) if camera.name == "c1" else camera for camera in cameras], "gained"

    monkeypatch.setattr(Outlines, "of", lambda *_: "found")
    monkeypatch.setattr("hnerf.calibration.person.calibrate.follow_outlines", follow)
    found = calibrated(tmp_path, truth, detections(truth, 0.0), ["c0"])
    assert worst_errors(found.cameras, [turned(c, 0.5) if c.name == "c1" else c for c in truth])[0] < 0.1


def test_the_frame_interval_follows_from_rate_and_stride(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every third frame at 60 frames a second: 50 ms apart."""
    truth, intervals_s = ring(3), []
    capture = write_capture(tmp_path, without_poses(truth), detections(truth, 1.0))
    capture = dataclasses.replace(capture, fps=60.0, train_frames=tuple(range(0, 36, 3)))

    def stood(cameras: list[Camera], points_m: np.ndarray, frame_s: float) -> tuple[list[Camera], float]:
        intervals_s.append(frame_s)
        return stand_on_ground(cameras, points_m, frame_s)

    monkeypatch.setattr("hnerf.calibration.person.calibrate.stand_on_ground", stood)
    calibrate_from_person(capture, [], dict.fromkeys(capture.cameras, "given"), STATURE_M)
    assert intervals_s == [pytest.approx(0.05)]


def test_without_a_height_the_mean_is_used_and_reported(tmp_path: Path) -> None:
    truth = ring(3)
    capture = write_capture(tmp_path, without_poses(truth), detections(truth, 1.0))
    found = calibrate_from_person(capture, [], dict.fromkeys(capture.cameras, "given"), None)
    assert found.scale_sd == pytest.approx(np.hypot(0.03, 0.09 / 1.65))
    assert found.notes()[0] == "scale: a person of 1.65 m, the mean of adults (state stature_m in capture.toml), +- 6 %"


def test_a_lens_is_given_for_images_of_the_recorded_size(tmp_path: Path) -> None:
    """Images of 2000 px were shrunk to 1000 px: the focal length doubles, and the middle at 499.5 becomes 999.5."""
    capture = write_capture(tmp_path, ring(1), detections(ring(1), 0.0))
    capture = dataclasses.replace(capture, recorded_sizes_px={"c0": (2000, 2000)})
    posed = capture.cameras["c0"]
    lens = calibrate._as_recorded(capture, posed, -0.1)
    np.testing.assert_allclose(lens.K, [[2000, 0, 999.5], [0, 2000, 999.5], [0, 0, 1]])
    assert lens.size_px == (2000, 2000) and lens.distortion.tolist() == [-0.1, 0, 0, 0]
    given = ([[2000.0, 0, 999.5], [0, 2000, 999.5], [0, 0, 1]], [0.1, 0.2, 0.3, 0.4])
    for stored, fisheye in ((given, False), ((*given, True), True)):
        lens = calibrate._as_recorded(dataclasses.replace(capture, recorded_lenses={"c0": stored}), posed, 0.0)
        assert lens.fisheye == fisheye and lens.distortion.tolist() == [0.1, 0.2, 0.3, 0.4]
        assert lens.size_px == (2000, 2000) and lens.K.tolist() == given[0]


def refusal(tmp_path: Path, cameras: list[Camera], seen: np.ndarray, unknown: list[str]) -> str:
    with pytest.raises(InputError) as refused:
        calibrated(tmp_path, cameras, seen, unknown)
    return str(refused.value)


def test_one_camera_is_refused(tmp_path: Path) -> None:
    assert "one camera" in refusal(tmp_path, ring(1), detections(ring(1), 1.0), [])


@pytest.mark.filterwarnings("error")
def test_joints_that_are_never_seen_do_not_count_as_still() -> None:
    """Feet, which few detectors find, are never seen. All other joints are at 0, 0.3 and 0.6 m along x: 0.3, 0 and
    0.3 m from their median position."""
    points_m = STANDING_M + np.array([0, 0.3, 0.6])[:, None, None] * [1, 0, 0]
    points_m[:, 19:] = np.nan
    assert calibrate._motion(points_m) == pytest.approx(0.3 / STATURE_M, rel=1e-3)


def test_a_person_who_stands_still_is_refused(tmp_path: Path) -> None:
    still = detections(ring(4), 1.0)[:, :1].repeat(12, axis=1)
    assert "stands still" in refusal(tmp_path, ring(4), still, [])


def test_cameras_that_look_along_one_line_are_refused(tmp_path: Path) -> None:
    line = [look_at(f"c{i}", np.array([3 + i, 0.02 * i, 1.2]), np.array([0, 0, 0.9])) for i in range(3)]
    assert "one direction" in refusal(tmp_path, line, detections(line, 1.0), [])


@pytest.mark.parametrize("count", [2, 3])
def test_cameras_in_one_line_cannot_find_the_focal_length(count: int, tmp_path: Path) -> None:
    """Two cameras are always in one line."""
    line = [look_at(f"c{i}", np.array([3.5, 2.0 * i - 2, 1.2]), np.array([0, 0, 0.9])) for i in range(count)]
    message = refusal(tmp_path, line, detections(line, 1.0), [camera.name for camera in line])
    assert "one line" in message and message.endswith("or --lens), or add a camera beside that line")


def test_too_few_shared_keypoints_are_refused(tmp_path: Path) -> None:
    seen = detections(ring(3), 1.0)
    seen[2, 2:, :, 2] = 0
    assert "camera c2 shares at most 50 keypoints" in refusal(tmp_path, ring(3), seen, [])


def test_recordings_of_different_times_are_refused(tmp_path: Path) -> None:
    seen = detections(ring(4), 1.0)
    seen[1] = seen[1, [5, 2, 9, 0, 11, 7, 1, 10, 4, 8, 3, 6]]
    message = refusal(tmp_path, ring(4), seen, [])
    assert message.startswith("ring: camera c1 does not see the same person at the same time as the others")


def test_a_camera_that_the_keypoints_do_not_determine_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limits are 5 degrees and a tenth of the distance from the origin, which is less than 4 m."""
    sure = dict.fromkeys(("c0", "c1", "c2"), Uncertainty(4.9, 0.3, 0.0))
    _check_uncertainty(ring(3), sure)
    for unsure, words in (
        (Uncertainty(5.1, 0.3, 0.0), "5.1 degrees, 30"),
        (Uncertainty(4.9, 0.4, 0.0), "4.9 degrees, 40"),
    ):
        with pytest.raises(InputError, match=rf"camera c1 is not determined \(\+- {words} cm\)"):
            _check_uncertainty(ring(3), sure | {"c1": unsure})
    monkeypatch.setattr(calibrate, "MAX_TURN_SD_DEG", 0.0)
    assert "is not determined" in refusal(tmp_path, ring(3), detections(ring(3), 1.0), [])


def test_each_camera_takes_the_named_person_or_the_best_candidate(tmp_path: Path) -> None:
    """Two people walk side by side. The second is named in c0, and is a little larger in c1."""
    seen = detections(ring(2), 0.0)
    aside = np.array([200.0, 0, 0])
    both = np.stack([seen - aside, seen + aside], 2)
    middle = both[1, :, 1, :, :2].mean(1, keepdims=True)
    both[1, :, 1, :, :2] = middle + 1.05 * (both[1, :, 1, :, :2] - middle)
    capture = write_capture(tmp_path, without_poses(ring(2)), both)
    x, y, _ = both[0, 3, 1, 0]
    capture = dataclasses.replace(capture, subject_point=SubjectPoint((x, y), "c0", 3))
    np.testing.assert_array_equal(calibrate._each_alone(capture), both[:, :, 1])

"""Errors that all cameras agree on: exchanged sides, mirrored images."""

import dataclasses
from pathlib import Path

import numpy as np

from hnerf.calibration.doubts import doubts, doubts_about_pictures, doubts_about_test_cameras, exchanged_sides
from hnerf.capture.capture import Capture, write_image
from hnerf.geometry.camera import Camera
from tests.calibration.synthetic import FRAMES, SIZE_PX, detections, edited_keypoints, ring, walk_m, write_capture

# BODY_25: each right keypoint with its left counterpart
PAIRS = ((2, 5), (3, 6), (4, 7), (9, 12), (10, 13), (11, 14), (15, 16), (17, 18), (22, 19), (23, 20), (24, 21))


def exchanged(points: np.ndarray) -> np.ndarray:
    """Return points (..., 25, n) with the labels of left and right exchanged."""
    order = np.arange(25)
    for right, left in PAIRS:
        order[[right, left]] = left, right
    return points[..., order, :]


def test_exchanged_sides_are_detected_by_face_and_feet() -> None:
    """The figure starts facing +x, with its left side towards +y, and keeps turning."""
    assert exchanged_sides(walk_m()) == []
    (doubt,) = exchanged_sides(exchanged(walk_m()))
    assert doubt.startswith("left and right are exchanged")


def test_face_or_feet_suffice_to_detect_exchanged_sides() -> None:
    face, feet, neither = (exchanged(walk_m()) for _ in range(3))
    face[:, 19:] = np.nan
    feet[:, [0, 17, 18]] = np.nan
    neither[:, [0, 17, 18, *range(19, 25)]] = np.nan
    assert len(exchanged_sides(face)) == len(exchanged_sides(feet)) == 1
    assert exchanged_sides(neither) == []


def test_two_cameras_facing_each_other_cannot_detect_exchanged_sides(tmp_path: Path) -> None:
    """From 50 m on either side, lines of sight cross at less than three degrees; a third camera, at a right angle,
    reveals the exchange."""
    centres_m = ([50.0, 0, 0.9], [-50.0, 0, 0.9], [0, 50.0, 0.9])
    cameras = [dataclasses.replace(c, t_m=-c.R @ np.array(m)) for c, m in zip(ring(3), centres_m, strict=True)]
    capture = write_capture(tmp_path, cameras, detections(cameras, 1))
    keypoints = np.ones((3, FRAMES, 25, 3))
    (doubt,) = doubts(capture, keypoints, exchanged(walk_m()))
    assert doubt.startswith("left and right are exchanged")
    facing = dataclasses.replace(capture, train_cameras=("c0", "c1"))
    assert doubts(facing, keypoints[:2], exchanged(walk_m())) == ()


def with_masks(root: Path) -> tuple[Capture, np.ndarray]:
    """Write a capture whose masks are squares around the keypoints; also return the keypoints (C, frames, 25, 3)."""
    cameras = ring(3)
    seen = detections(cameras, 1)
    capture = write_capture(root, cameras, seen)
    for camera, people in zip(cameras, seen, strict=True):
        for frame, person in enumerate(people):
            mask = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
            for x, y in person[:, :2].round().astype(int).clip(20, SIZE_PX - 20):
                mask[y - 20 : y + 21, x - 20 : x + 21] = 255
            write_image(root / "masks" / camera.name / f"{frame:06d}.png", mask)
    return capture, seen


def test_masks_reveal_keypoints_of_mirrored_images(tmp_path: Path) -> None:
    capture, keypoints = with_masks(tmp_path)
    assert doubts_about_pictures(capture, keypoints) == []
    wrong = keypoints.copy()
    wrong[..., 0] = SIZE_PX - 1 - wrong[..., 0]
    (doubt,) = doubts_about_pictures(capture, wrong)
    assert "mirrored left to right 100%" in doubt


def test_inverted_masks_are_not_taken_for_mirrored_images(tmp_path: Path) -> None:
    """Keypoints at the left of every image lie outside its inverted mask; mirrored to the right, they lie inside it."""
    capture, keypoints = with_masks(tmp_path)
    keypoints[..., 0] = SIZE_PX / 8
    for path in (tmp_path / "masks").glob("*/*.png"):
        inverted = np.full((SIZE_PX, SIZE_PX), 255, np.uint8)
        inverted[:, : SIZE_PX // 4] = 0
        write_image(path, inverted)
    assert doubts_about_pictures(capture, keypoints) == []


def test_masks_reveal_keypoints_that_do_not_belong_to_the_images_of_one_camera(tmp_path: Path) -> None:
    capture, keypoints = with_masks(tmp_path)
    first, mirrored = capture.train_cameras[0], keypoints.copy()
    mirrored[0, ..., 0] = SIZE_PX - 1 - mirrored[0, ..., 0]
    (doubt,) = doubts_about_pictures(capture, mirrored)
    assert doubt.startswith(f"camera {first}: ") and "mirrored 100%" in doubt
    first_line, _ = doubts_about_pictures(capture, keypoints[[1, 0, 2]])
    assert f"those of camera {capture.train_cameras[1]} 100%" in first_line
    (doubt,) = doubts_about_pictures(capture, np.concatenate([keypoints[:1, ::-1], keypoints[1:]]))
    assert doubt.startswith(f"camera {first}: ") and "in reverse order" in doubt
    elsewhere = keypoints.copy()
    elsewhere[0, ..., :2] = 3
    (doubt,) = doubts_about_pictures(capture, elsewhere)
    assert doubt.startswith(f"camera {first}: 0% ") and "in other cameras 100%" in doubt


def test_masks_that_are_loose_or_show_half_the_person_raise_no_doubt(tmp_path: Path) -> None:
    capture, keypoints = with_masks(tmp_path)
    for frame, people in enumerate(keypoints[0]):
        middle_px = int(people[8, 1])
        mask = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
        mask[:middle_px] = 255
        write_image(tmp_path / "masks" / capture.train_cameras[0] / f"{frame:06d}.png", mask)
    assert doubts_about_pictures(capture, keypoints) == []


def test_without_masks_or_plates_there_is_no_doubt(tmp_path: Path) -> None:
    capture = write_capture(tmp_path, ring(3), detections(ring(3), 1))
    assert doubts_about_pictures(capture, detections(ring(3), 1)) == []


def with_a_test_camera(root: Path, wrong: Camera, detected: bool) -> Capture:
    """Write a capture of three training cameras and a test camera that is calibrated as `wrong`."""
    *others, test = ring(4)
    seen = detections([*others, test] if detected else others, 1)
    capture = write_capture(root, [*others, dataclasses.replace(wrong, name=test.name)], seen)
    return dataclasses.replace(capture, train_cameras=capture.train_cameras[:3], test_cameras=(test.name,))


def test_a_wrongly_calibrated_test_camera_is_doubted(tmp_path: Path) -> None:
    """Without keypoints of its own, it is doubted if it cannot see the person."""
    first, *_, test = ring(4)
    millimetres = dataclasses.replace(test, t_m=1000 * test.t_m)
    behind = dataclasses.replace(test, t_m=test.t_m - [0, 0, 100])
    expected = {
        ("right", True): 0, ("right", False): 0, ("another", True): 1, ("another", False): 0, ("mm", True): 1,
        ("mm", False): 1, ("behind", True): 1, ("behind", False): 1,
    }  # fmt: skip
    cameras = {"right": test, "another": first, "mm": millimetres, "behind": behind}
    for (what, detected), count in expected.items():
        capture = with_a_test_camera(tmp_path / f"{what}{detected}", cameras[what], detected)
        lines = doubts(capture, np.zeros((3, FRAMES, 25, 3)), walk_m())
        assert len(lines) == count, (what, detected, lines)
        assert all(line.startswith("camera c3, for testing: ") for line in lines)


def test_a_test_camera_may_also_see_somebody_else_or_nobody(tmp_path: Path) -> None:
    capture = with_a_test_camera(tmp_path, ring(4)[3], detected=True)
    points_m = walk_m()
    points_m[0] = points_m[:, 3] = np.nan
    with edited_keypoints(tmp_path) as found:
        found["c3"] = np.concatenate([found["c3"] + [300, 0, 0], found["c3"]], 1)
        found["c3"][1] = 0
    assert doubts_about_test_cameras(capture, points_m) == []
    with edited_keypoints(tmp_path) as found:
        found["c3"][:] = 0
    assert doubts_about_test_cameras(capture, points_m) == []


def test_a_world_upside_down_is_doubted(tmp_path: Path) -> None:
    capture = write_capture(tmp_path, ring(3), detections(ring(3), 1))
    (doubt,) = doubts(capture, np.ones((3, FRAMES, 25, 3)), walk_m() * [1, -1, -1])
    assert doubt.startswith("the trunk mostly points along -z, not up (+z)")

"""What all cameras agree on and still is wrong: sides, mirrored pictures."""

import dataclasses
from pathlib import Path

import numpy as np

from hnerf.calibration.doubts import exchanged_sides, mirrored
from hnerf.capture.capture import Capture, write_image
from tests.calibration.synthetic import SIZE_PX, detections, ring, walk_m, write_capture

# BODY_25: each right keypoint and its left one
PAIRS = ((2, 5), (3, 6), (4, 7), (9, 12), (10, 13), (11, 14), (15, 16), (17, 18), (22, 19), (23, 20), (24, 21))


def exchanged(points: np.ndarray) -> np.ndarray:
    """Return points (..., 25, n) with the labels of left and right exchanged."""
    order = np.arange(25)
    for right, left in PAIRS:
        order[[right, left]] = left, right
    return points[..., order, :]


def test_exchanged_sides_are_told_by_face_and_feet() -> None:
    """The figure faces +x with its left at +y, and turns on."""
    assert exchanged_sides(walk_m()) == []
    (doubt,) = exchanged_sides(exchanged(walk_m()))
    assert doubt.startswith("left and right are exchanged")


def test_the_face_or_the_feet_are_enough_and_neither_is_no_doubt() -> None:
    face, feet, neither = (exchanged(walk_m()) for _ in range(3))
    face[:, 19:] = np.nan
    feet[:, [0, 17, 18]] = np.nan
    neither[:, [0, 17, 18, *range(19, 25)]] = np.nan
    assert len(exchanged_sides(face)) == len(exchanged_sides(feet)) == 1
    assert exchanged_sides(neither) == []


def with_masks(root: Path) -> tuple[Capture, np.ndarray]:
    """Write a capture whose masks are squares around the keypoints; also return the keypoints (C, frames, 25, 3)."""
    cameras = ring(3)
    seen = detections(cameras, 1)
    capture = write_capture(root, cameras, seen)
    for name, people in seen.items():
        for frame, (person,) in enumerate(people):
            mask = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
            for x, y in person[:, :2].round().astype(int).clip(20, SIZE_PX - 20):
                mask[y - 20 : y + 21, x - 20 : x + 21] = 255
            write_image(root / "masks" / name / f"{frame:06d}.png", mask)
    return dataclasses.replace(capture, root=root), np.stack([people[:, 0] for people in seen.values()])


def test_keypoints_of_mirrored_pictures_are_told_by_masks(tmp_path: Path) -> None:
    capture, keypoints = with_masks(tmp_path)
    assert mirrored(capture, keypoints) == []
    wrong = keypoints.copy()
    wrong[..., 0] = SIZE_PX - 1 - wrong[..., 0]
    (doubt,) = mirrored(capture, wrong)
    assert "mirrored left to right 100%" in doubt


def test_without_masks_or_plates_there_is_no_doubt(tmp_path: Path) -> None:
    capture = write_capture(tmp_path, ring(3), detections(ring(3), 1))
    assert mirrored(capture, np.stack([people[:, 0] for people in detections(ring(3), 1).values()])) == []

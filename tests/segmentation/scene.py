"""A synthetic person in one or more views of a textured room, with a soft shadow; the masks are known."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np

from hnerf.capture.capture import Capture, write_image
from tests.calibration.synthetic import STANDING_M, edited_keypoints, look_at, write_capture

SIZE_PX = 400
FRAMES = 8
PERSON_RGB, STRANGER_RGB = (60, 80, 150), (150, 60, 60)
LIMBS = ((1, 2), (2, 3), (3, 4), (1, 5), (5, 6), (6, 7), (8, 9), (9, 10), (10, 11), (8, 12), (12, 13), (13, 14),
         (14, 19), (11, 22))  # fmt: skip


def write_scene(
    root: Path, cameras: int = 1, plate: bool = True, moves_m: float = 0.5, stranger_px: int = 0, glossy: bool = False
) -> tuple[Capture, dict]:
    """Write a capture of a stick person walking across; return the true masks by (camera, frame). stranger_px: how far
    to the left another person stands, 0 for nobody; glossy: whether the floor reflects."""
    rng = np.random.default_rng(0)
    middle = np.array([0, 0, 0.9])
    places = [np.array([3.5 * np.cos(a), 3.5 * np.sin(a), 1.0]) for a in 1.2 * np.arange(cameras)]
    views = [look_at(f"c{i}", place, middle).resized(SIZE_PX, SIZE_PX) for i, place in enumerate(places)]
    seen, truth = [], {}
    for camera in views:
        room = cv2.resize(rng.integers(90, 200, (40, 40, 3)).astype(np.uint8), (SIZE_PX, SIZE_PX))
        poses_px = []
        for frame in range(FRAMES):
            sideways = moves_m * (frame - FRAMES / 2) / FRAMES
            pose_m = STANDING_M + sideways * np.array([-1.0, 1, 0])
            pose_px = camera.project(pose_m)[0]
            truth[camera.name, frame] = person(pose_px)
            shadow = np.roll(cv2.GaussianBlur(truth[camera.name, frame].astype(np.float32), (0, 0), 9), 45, axis=1)
            image = room * (1 - 0.5 * shadow[..., None])
            if glossy:
                mirrored = _mirrored(truth[camera.name, frame])
                image[mirrored] = 0.4 * image[mirrored] + 0.6 * np.array(PERSON_RGB)
            if stranger_px:
                image[np.roll(person(camera.project(STANDING_M)[0]), -stranger_px, axis=1)] = STRANGER_RGB
            image[truth[camera.name, frame]] = PERSON_RGB
            noisy = (image + rng.normal(size=image.shape) * 2).clip(0, 255).astype(np.uint8)
            write_image(root / "images" / camera.name / f"{frame:06d}.png", noisy)
            poses_px.append(np.concatenate([pose_px, np.full((25, 1), 0.8)], 1))
        seen.append(poses_px)
        if plate:
            write_image(root / "background" / f"{camera.name}.png", room)
    return write_capture(root, views, np.array(seen)), truth


def write_likely(capture: Capture, masks: dict) -> None:
    """Write person probabilities as from a network: the masks, blurred by 2 px, and a poster in a corner."""
    for (camera, frame), mask in masks.items():
        likely = cv2.GaussianBlur(np.where(mask, 255.0, 0.0), (0, 0), 2)
        likely[:40, :30] = 255
        write_image(capture.root / "person" / camera / f"{frame:06d}.png", likely.round().astype(np.uint8))


def person(pose_px: np.ndarray) -> np.ndarray:
    """Draw a person with thick limbs, trunk and head, (H, W) bool."""
    image = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
    at = pose_px.round().astype(np.int32)
    for a, b in LIMBS:
        cv2.line(image, at[a].tolist(), at[b].tolist(), 1, 13)
    cv2.fillConvexPoly(image, cv2.convexHull(at[[2, 5, 9, 12]]), 1)
    cv2.circle(image, at[0].tolist(), 12, 1, cv2.FILLED)
    cv2.line(image, at[0].tolist(), at[1].tolist(), 1, 9)
    return image.astype(bool)


def _mirrored(mask: np.ndarray) -> np.ndarray:
    """Return the mask (H, W) bool mirrored at its lowest row."""
    feet = int(np.flatnonzero(mask.any(1))[-1])
    below = np.zeros_like(mask)
    shown = mask[: feet + 1][::-1][: SIZE_PX - feet - 1]
    below[feet + 1 : feet + 1 + len(shown)] = shown
    return below


def write_masks(capture: Capture, masks: dict) -> None:
    """Write given masks next to the images."""
    for (camera, frame), mask in masks.items():
        write_image(capture.root / "masks" / camera / f"{frame:06d}.png", np.where(mask, 255, 0).astype(np.uint8))


def only_frames(capture: Capture, count: int) -> Capture:
    """Keep the first frames only, and remove the keypoints of the others from the folder, too."""
    with edited_keypoints(capture.root) as found:
        found |= {name: seen[:count] for name, seen in found.items()}
    return dataclasses.replace(capture, train_frames=tuple(range(count)), novel_pose_frames=())

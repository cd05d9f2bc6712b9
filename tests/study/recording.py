"""A small synthetic capture, normalised: two training cameras and a test camera, five frames."""

from pathlib import Path

import numpy as np

from hnerf.capture.capture import HANDS, LANDMARKS, PERSON, Capture, write_image
from hnerf.geometry.camera import Camera

SIZE_PX = 16
FRAMES = (2, 4, 6, 8, 10)
K = np.array([[16.0, 0, 7.5], [0, 16.0, 7.5], [0, 0, 1]])
# 01 looks along world +x from (-4, 0, 1), 02 along +y from (0, -4, 1), 03 along -x from (4, 0, 1); z is up.
ROTATIONS = {
    "01": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    "02": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "03": np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]]),
}


def write_recording(folder: Path) -> Capture:
    """Write images of value 100 + frame, plates of 50, and masks of the middle 8 x 8 px. Keypoint 1 is at (frame, 5),
    the others are in the image's middle, with confidence 1. Cameras 01 and 02 are for training."""
    sizes = dict.fromkeys(ROTATIONS, (SIZE_PX, SIZE_PX))
    cameras = {name: Camera(name, K, R, np.array([0.0, 1, 4]), SIZE_PX, SIZE_PX) for name, R in ROTATIONS.items()}
    capture = Capture("ada", folder, cameras, ("01", "02"), ("03",), FRAMES[:3], FRAMES[3:], 10.0, "z", sizes, sizes)
    dark, mask = np.ones((SIZE_PX, SIZE_PX, 3), np.uint8), np.zeros((SIZE_PX, SIZE_PX), np.uint8)
    mask[4:12, 4:12] = 255
    for name in ROTATIONS:
        for frame in FRAMES:
            write_image(folder / "images" / name / f"{frame:06d}.png", (100 + frame) * dark)
            write_image(folder / "masks" / name / f"{frame:06d}.png", mask)
        write_image(folder / "background" / f"{name}.png", 50 * dark)
    people = np.full((len(FRAMES), 1, 25, 3), 7.5)
    people[..., 2] = 1
    people[:, 0, 1, 0], people[:, 0, 1, 1] = FRAMES, 5
    np.savez_compressed(folder / "keypoints.npz", **dict.fromkeys(ROTATIONS, people))  # type: ignore[arg-type]
    capture.save()
    return capture


def write_detected(capture: Capture) -> None:
    """Write detections of networks in the training cameras. In every frame these are a person mask of 200 in the middle
    8 x 8 px and of the frame's number elsewhere; landmarks; and two hands, whose points are all at (frame, 5), except
    the first of the left hand, at (7.5, 7.5)."""
    likely = {frame: np.full((SIZE_PX, SIZE_PX), frame, np.uint8) for frame in capture.frames}
    hands = np.ones((len(capture.frames), 2, 21, 3))
    hands[..., 0], hands[..., 1] = np.array(capture.frames)[:, None, None], 5
    hands[:, 0, 0, :2] = 7.5
    np.savez(capture.root / HANDS, **dict.fromkeys(capture.train_cameras, hands))  # type: ignore[arg-type]
    for name in capture.train_cameras:
        write_landmarks(capture, name)
        for frame, mask in likely.items():
            mask[4:12, 4:12] = 200
            write_image(capture.root / PERSON / name / f"{frame:06d}.png", mask)


def write_landmarks(capture: Capture, camera: str) -> None:
    """Write the landmarks of one person: all at x = frame, y = 5 px with confidence 1, and frame / 10 metres in x, y
    and z."""
    frame = np.array(capture.frames)[:, None, None]
    points = np.stack(np.broadcast_arrays(frame, 5, 1), -1) * np.ones((1, 1, 33, 1))
    (capture.root / LANDMARKS).mkdir(exist_ok=True)
    np.savez(capture.root / LANDMARKS / f"{camera}.npz", points_px=points, points_m=points[..., :1] / 10 * np.ones(3))

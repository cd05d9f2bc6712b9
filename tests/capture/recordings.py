"""Small synthetic recordings in each layout, for tests to read and to damage."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from hnerf.capture.capture import write_image
from hnerf.capture.ingest import ingest
from hnerf.config import CaptureSettings
from hnerf.errors import InputError

WIDTH, HEIGHT = 24, 16
CAMERAS = ("01", "02")
FRAMES = (0, 1, 2, 3, 4)
K = [[20.0, 0, 11.5], [0, 20.0, 7.5], [0, 0, 1]]
# Camera 01 looks along world +x from (-3, 0, 1); camera 02 along +y from (0, -3, 1). Z is up.
ROTATIONS = {"01": [[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], "02": [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]}
TRANSLATIONS_M = {"01": [0.0, 1, 3], "02": [0.0, 1, 3]}


def picture(camera: str, frame: int) -> np.ndarray:
    """Return an image (16, 24, 3) uint8 RGB of noise; no two are equal."""
    return np.random.default_rng([int(camera[-2:]), frame]).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def write_keypoints(path: Path, people: list, hands: list | None = None) -> None:
    """Write an OpenPose file of people (K, 3). hands: of each of them, left and right, (21, 3) or an empty list."""
    path.parent.mkdir(parents=True, exist_ok=True)
    triples = [{"pose_keypoints_2d": np.ravel(points).tolist()} for points in people]
    for person, sides in zip(triples, hands or [], strict=False):
        for side, points in zip(("left", "right"), sides, strict=True):
            person[f"hand_{side}_keypoints_2d"] = np.ravel(points).tolist()
    path.write_text(json.dumps({"people": triples}))


def write_calibration(folder: Path, distortion: tuple[float, ...] = (0,) * 5, t_scale: float = 1.0) -> None:
    """Write intri.yml and extri.yml for both cameras."""
    intri = cv2.FileStorage(str(folder / "intri.yml"), cv2.FILE_STORAGE_WRITE)
    extri = cv2.FileStorage(str(folder / "extri.yml"), cv2.FILE_STORAGE_WRITE)
    for storage in (intri, extri):
        storage.startWriteStruct("names", cv2.FILE_NODE_SEQ)
        for camera in CAMERAS:
            storage.write("", camera)
        storage.endWriteStruct()
    for camera in CAMERAS:
        intri.write(f"K_{camera}", np.array(K))
        intri.write(f"dist_{camera}", np.array([distortion]))
        intri.write(f"W_{camera}", WIDTH)
        intri.write(f"H_{camera}", HEIGHT)
        extri.write(f"R_{camera}", cv2.Rodrigues(np.array(ROTATIONS[camera]))[0])
        extri.write(f"T_{camera}", t_scale * np.array(TRANSLATIONS_M[camera])[:, None])
    intri.release()
    extri.release()


def write_easymocap(folder: Path) -> Path:
    """Write two cameras, five frames, PNG images, one person; frame 2 of camera 02 has two people."""
    folder.mkdir()
    write_calibration(folder)
    for camera in CAMERAS:
        for frame in FRAMES:
            write_image(folder / "images" / camera / f"{frame:06d}.png", picture(camera, frame))
            person = np.tile([3.0 + frame, 5.0, 0.5], (25, 1))
            people = [person, person + np.array([1.0, 0, 0])] if (camera, frame) == ("02", 2) else [person]
            write_keypoints(folder / "openpose" / camera / f"{frame:06d}_keypoints.json", people)
    return folder


def write_video(path: Path, count: int, size_px: tuple[int, int] = (64, 48), fps: float = 25.0) -> None:
    """Write a video whose frame f has the grey level 20 + 20 f."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size_px)
    assert writer.isOpened()
    for frame in range(count):
        writer.write(np.full((size_px[1], size_px[0], 3), 20 + 20 * frame, np.uint8))
    writer.release()


def write_pose2sim(folder: Path) -> Path:
    """Write two cameras with ten frames of 64 x 48 px, calibrated at that size, and no people detected."""
    tables = []
    for camera in CAMERAS:
        rotation = cv2.Rodrigues(np.array(ROTATIONS[camera]))[0].ravel().tolist()
        tables.append(
            f'[cam{camera}]\nname = "cam{camera}"\nsize = [64.0, 48.0]\n'
            "matrix = [[50.0, 0.0, 31.5], [0.0, 50.0, 23.5], [0.0, 0.0, 1.0]]\ndistortions = [0.0, 0.0, 0.0, 0.0]\n"
            f"rotation = {rotation}\ntranslation = {TRANSLATIONS_M[camera]}\nfisheye = false\n"
        )
        write_video(folder / "videos" / f"cam{camera}.mp4", 10)
        for frame in range(10):
            write_keypoints(folder / "pose" / f"cam{camera}_json" / f"cam{camera}_{frame:06d}.json", [])
    (folder / "calibration").mkdir()
    (folder / "calibration" / "Calib.toml").write_text("\n".join([*tables, "[metadata]\nerror = 0.0\n"]))
    return folder


def refusal(folder: Path, out: Path) -> str:
    """Return the message with which a recording is refused: one line, and no capture is written."""
    with pytest.raises(InputError) as refused:
        ingest(folder, CaptureSettings(), out)
    assert "\n" not in str(refused.value) and not (out / "capture.json").exists()
    return str(refused.value)

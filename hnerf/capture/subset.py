"""Subsets of a capture: fewer training cameras, fewer frames."""

import dataclasses
import shutil
from collections.abc import Callable, Collection, Mapping
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import TypeVar

import numpy as np

from hnerf.capture.board_footage import BOARDS_FILE
from hnerf.capture.capture import HANDS, KEYPOINTS, LANDMARKS, PERSON, Capture, SubjectPoint
from hnerf.capture.subject import subject_keypoints
from hnerf.errors import InputError, NotApplicableError

T = TypeVar("T")
PointChange = Callable[[str, np.ndarray], np.ndarray]


def require_several_cameras(capture: Capture) -> None:
    """Raise NotApplicableError if the capture has a single training camera, which cannot differ from others."""
    if len(capture.train_cameras) < 2:
        raise NotApplicableError(f"{capture.name}: has only one training camera; this needs several")


def subset(
    capture: Capture,
    out: Path,
    cameras: tuple[str, ...] | None = None,
    train_frames: tuple[int, ...] | None = None,
    novel_pose_frames: tuple[int, ...] | None = None,
) -> None:
    """Write another normalised capture into `out` with only these training cameras and frames; None keeps all.

    capture: as ingested, with synchronised cameras. Test cameras are kept. Frames keep their numbers, so that ground
    truth can be found by them. Raises InputError if a camera or frame is not one of the capture's, or nothing is left
    to train on.
    """
    train_cameras = select(capture, "training camera", cameras, capture.train_cameras)
    kept = dataclasses.replace(
        capture,
        root=out,
        cameras={name: capture.cameras[name] for name in (*train_cameras, *capture.test_cameras)},
        train_cameras=train_cameras,
        train_frames=select(capture, "training frame", train_frames, capture.train_frames),
        novel_pose_frames=select(capture, "novel-pose frame", novel_pose_frames, capture.novel_pose_frames),
    )
    kept = dataclasses.replace(kept, subject_point=subject_point(capture, kept))
    if not kept.train_cameras or not kept.train_frames:
        raise InputError(f"{capture.name}: no training camera or frame would be left; keep one of each")
    write_arrays(capture, kept)
    for name in kept.cameras:
        copy_pixels(capture, kept, name)
    kept.save()


def subject_point(capture: Capture, kept: Capture, change: PointChange | None = None) -> SubjectPoint | None:
    """Return the point that names the subject; if its camera or frame is left out, or points change as in
    `write_arrays`, a keypoint of the subject in the kept capture."""
    point = capture.subject_point
    if point is None or not point.camera or capture.keypoints(point.camera) is None:
        return point
    if not change and point.camera in kept.train_cameras and point.frame in kept.frames:
        return point
    found = {name: change(name, points) if change else points for name, points in subject_keypoints(capture).items()}
    for name, frame in product(kept.train_cameras, kept.frames):
        x, y, confidence = max(found[name][capture.frames.index(frame)].tolist(), key=itemgetter(2))
        if confidence:
            return SubjectPoint((x, y), name, frame)
    return point


def write_arrays(
    capture: Capture,
    kept: Capture,
    change: PointChange = lambda _, points: points,
    shown: Mapping[str, tuple[int, ...]] | None = None,
) -> None:
    """Write keypoints, hands, landmarks and given poses of the kept frames and cameras, and copy the board footage.
    `change(camera, points)` is applied to all image points (frames, ..., 3). shown: as in `copy_pixels`, by camera."""
    frames = dict.fromkeys(kept.cameras, kept.frames) | dict(shown or {})
    rows = {name: np.searchsorted(capture.frames, frames[name]) for name in kept.cameras}
    for file, read in ((KEYPOINTS, capture.keypoints), (HANDS, capture.hands)):
        found = {name: points for name in kept.cameras if (points := read(name)) is not None}
        write_points(kept.root / file, {name: change(name, points[rows[name]]) for name, points in found.items()})
    for name in kept.cameras:
        landmarks = capture.landmarks(name)
        if landmarks is not None:
            points_px, points_m = (points[rows[name]] for points in landmarks)
            write_points(
                kept.root / LANDMARKS / f"{name}.npz", {"points_px": change(name, points_px), "points_m": points_m}
            )
    poses = capture.given_poses()
    if poses:
        own = np.searchsorted(capture.frames, kept.frames)
        dataclasses.replace(poses, theta=poses.theta[own], root=poses.root[own]).save(kept.root / "poses.npz")
    copy_files(capture.root, kept.root, {Path(BOARDS_FILE).stem})


def write_points(path: Path, points: dict[str, np.ndarray]) -> None:
    """Write arrays of points by name; no file if there are none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if points:
        np.savez_compressed(path, **points)  # type: ignore[arg-type]


def copy_pixels(capture: Capture, kept: Capture, camera: str, shown: tuple[int, ...] | None = None) -> None:
    """Copy one camera's images, clean plate, given masks and detected person masks, file by file, unchanged. shown: for
    each kept frame, the capture's frame that it shows; None for the same."""
    for folder in ("images", "masks", PERSON):
        stored = {path.stem: path for path in (capture.root / folder / camera).glob("*")}
        for frame, source in zip(kept.frames, shown or kept.frames, strict=True):
            path = stored.get(f"{source:06d}")
            if path:
                target = kept.root / folder / camera / f"{frame:06d}{path.suffix}"
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, target)
    copy_files(capture.root / "background", kept.root / "background", {camera})


def copy_files(source: Path, target: Path, stems: Collection[str]) -> None:
    """Copy the files of a folder, if there is one, whose names without suffix are among `stems`."""
    for path in sorted(source.glob("*")):
        if path.stem in stems:
            target.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target / path.name)


def select(capture: Capture, what: str, wanted: tuple[T, ...] | None, available: tuple[T, ...]) -> tuple[T, ...]:
    """Return those of the available items that are wanted, in their order, or all for None. Raises InputError for an
    item that is not available."""
    if wanted is None:
        return available
    for one in wanted:
        if one not in available:
            raise InputError(f"{capture.name}: no {what} {one}; there are {', '.join(map(str, available))}")
    return tuple(one for one in available if one in wanted)

"""The PeopleSnapshot layout: camera.pkl, one video, masks.hdf5, keypoints.hdf5, reconstructed_poses.hdf5."""

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import cv2
import h5py
import numpy as np

from hnerf.capture.footage import Footage, Video
from hnerf.capture.formats.layout import Layout, StoredFrame
from hnerf.capture.given_poses import JOINTS, GivenPoses, check_smpl
from hnerf.capture.keypoint_files import without_far_points
from hnerf.capture.lens import Lens, checked_lens
from hnerf.capture.safe_io import MAX_IMAGE_PIXELS, VIDEO_SUFFIXES, files_in, path_in_capture
from hnerf.capture.safe_pickle import read_pickle
from hnerf.errors import InputError
from hnerf.geometry.axes import CAMERA_FROM_Z_UP

CAMERA = "camera"
COCO_POINTS = 18
MAX_NUMBERS = 10_000_000  # in an array of keypoints or poses: more than an hour of them


@dataclass(frozen=True)
class PeopleSnapshot(Layout):
    """A subject's folder as the publication's own tools read it; the world is rotated so that Z is up."""

    mark = "camera.pkl"

    def lenses(self) -> dict[str, Lens]:
        """Return the one camera."""
        path = path_in_capture(self.folder, "camera.pkl")
        stored = read_pickle(path)
        try:
            focal, centre, distortion, turn, shift = (
                np.asarray(stored[f"camera_{key}"], dtype=np.float64) for key in ("f", "c", "k", "rt", "t")
            )
            K = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
            R = cv2.Rodrigues(turn)[0] @ CAMERA_FROM_Z_UP
            size_px = float(stored["width"]), float(stored["height"])
        except (IndexError, KeyError, OverflowError, TypeError, ValueError, cv2.error):
            raise InputError(f"{path}: camera_f, _c, _k, _rt, _t, width or height is missing; get it again") from None
        return {CAMERA: checked_lens(path, CAMERA, K, distortion, R, shift, size_px)}

    def footage(self, camera: str) -> Footage:
        """Return the one video, which is named after the subject."""
        return self._video

    @cached_property
    def _video(self) -> Video:
        videos = files_in(self.folder, suffixes=VIDEO_SUFFIXES)
        if len(videos) != 1:
            raise InputError(f"{self.folder}: {len(videos)} videos .mp4; leave exactly one")
        return Video.open(videos[0])

    def keypoint_files(self, camera: str) -> dict[int, StoredFrame]:
        """Return the frames of keypoints.hdf5: keypoints (N, 54), OpenPose's COCO model."""
        path = path_in_capture(self.folder, "keypoints.hdf5")
        if not path.exists():
            return {}
        count = self._one_a_frame(path, "keypoints")
        found = _array(path, "keypoints", (3 * COCO_POINTS,)).reshape(count, 1, COCO_POINTS, 3)
        found[..., 2] = found[..., 2].clip(0, 1)  # as those of keypoint files
        return {i: StoredFrame(path, path, points.copy) for i, points in enumerate(without_far_points(path, found))}

    def mask_files(self, camera: str) -> dict[int, StoredFrame]:
        """Return the frames of masks.hdf5: masks (N, H, W), 0 outside the person."""
        path = path_in_capture(self.folder, "masks.hdf5")
        count = self._one_a_frame(path, "masks") if path.exists() else 0
        return {i: StoredFrame(path, path, partial(_mask, path, i)) for i in range(count)}

    def _one_a_frame(self, path: Path, name: str) -> int:
        """Return the number of frames. Raises InputError unless a dataset declares a row for each, before anything is
        allocated for it."""
        declared, count = _count(path, name), len(self._video.frames)
        if declared != count:
            raise InputError(f"{path}: {declared} {name} for {count} frames; give one for each")
        return count

    def given_poses(self, frames: tuple[int, ...]) -> GivenPoses | None:
        """Return the poses of reconstructed_poses.hdf5: pose (N, 72), trans (N, 3), betas (10).

        If there are more poses than masks, they are aligned at the end. A frame that is all zero was never
        reconstructed.
        """
        path = path_in_capture(self.folder, "reconstructed_poses.hdf5")
        if not path.exists():
            return None
        turns, moves_m = _array(path, "pose", (3 * JOINTS,)), _array(path, "trans", (3,))
        if len(turns) != len(moves_m):
            raise InputError(f"{path}: {len(turns)} poses, {len(moves_m)} translations; get it again")
        masks = path_in_capture(self.folder, "masks.hdf5")
        first = len(turns) - _count(masks, "masks") if masks.exists() else 0
        poses, betas = GivenPoses.unknown(len(frames)), _array(path, "betas", ())
        if len(betas) < len(poses.betas):
            raise InputError(f"{path}: {len(betas)} betas are not SMPL's; get it again")
        check_smpl(path, turns, moves_m, betas)
        poses.betas[:] = betas[: len(poses.betas)]
        for i, frame in enumerate(frames):
            row = frame + first
            if 0 <= row < len(turns) and (turns[row].any() or moves_m[row].any()):
                poses.theta[i] = turns[row].reshape(JOINTS, 3)
                poses.root[i] = np.eye(4)
                poses.root[i, :3, :3], poses.root[i, :3, 3] = CAMERA_FROM_Z_UP.T, CAMERA_FROM_Z_UP.T @ moves_m[row]
        return poses


def _array(path: Path, name: str, row_shape: tuple[int, ...]) -> np.ndarray:
    """Read all of a small dataset of rows as float64. Raises InputError unless it is of finite numbers."""
    with _dataset(path, name) as data:
        found = data[()].astype(np.float64) if data.size <= MAX_NUMBERS else np.zeros(())
    if found.ndim != 1 + len(row_shape) or found.shape[1:] != row_shape or not np.isfinite(found).all():
        raise InputError(f"{path}: {name} is not (N, {', '.join(map(str, row_shape))}) finite numbers; get it again")
    return found


def _count(path: Path, name: str) -> int:
    """Return the number of rows of a dataset."""
    with _dataset(path, name) as data:
        return len(data)


def _mask(path: Path, row: int) -> np.ndarray:
    """Read the mask of one frame, (H, W) uint8."""
    with _dataset(path, "masks") as data:
        if data.ndim != 3 or data.dtype.itemsize * math.prod(data.shape[1:]) > MAX_IMAGE_PIXELS:
            raise InputError(f"{path}: masks are not images (N, H, W); get it again")
        return 255 * (data[row] != 0).astype(np.uint8)


@contextmanager
def _dataset(path: Path, name: str) -> Iterator[h5py.Dataset]:
    """Open a dataset of numbers in an HDF5 file. Raises InputError unless it can be read and lies in this very file, in
    chunks of a sane size."""
    sys.audit("open", str(path), "r", 0)  # announced as Python's own open does
    try:
        with h5py.File(path, "r") as file:
            data = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
            if not isinstance(data, h5py.Dataset) or data.ndim == 0 or data.dtype.kind not in "biuf":
                raise InputError(f"{path}: has no array of numbers called {name}; get it again")
            chunk_bytes = data.dtype.itemsize * math.prod(data.chunks or (1,))
            if data.is_virtual or data.external or chunk_bytes > MAX_IMAGE_PIXELS:
                raise InputError(f"{path}: {name} lies in other files, or in huge chunks; write it again")
            yield data
    except (KeyError, OSError, OverflowError, RuntimeError, TypeError, ValueError):  # damage beyond the first bytes
        raise InputError(f"{path}: not a readable HDF5 file; get it again") from None

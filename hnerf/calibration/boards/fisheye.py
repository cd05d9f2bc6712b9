"""Intrinsics of a fisheye from images of a board: least squares over the lens and the poses of the board.

`cv2.fisheye.calibrate` does the same, but in OpenCV 5.0 it raises errors on most such images, and it returns no
standard deviations.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from hnerf.calibration.boards.rig import fixes_pose
from hnerf.capture.lens import Lens, undistort_points

LENS = 8  # unknowns fx fy cx cy k1 k2 k3 k4, before 6 for each image: rotation vector and translation
GUESSES_DEG = (90, 110, 130, 150, 170, 190)  # across the longer side of an equidistant lens, to start from the best
MAX_ITERATIONS = 100


class FisheyeFit(NamedTuple):
    """A fisheye that was fitted to corners. turns: rotation vectors of the board in each image; focal_std: the focal
    length's relative standard deviation; rms_px: how far corners are from where the lens images them."""

    lens: Lens
    turns: list[np.ndarray]
    focal_std: float
    rms_px: float


def fit_fisheye(
    name: str, points_m: Sequence[np.ndarray], points_px: Sequence[np.ndarray], size_px: tuple[int, int]
) -> FisheyeFit:
    """Return the fisheye that images the points (N, 3) of each image's board closest to where they were seen (N, 2), in
    the least squares. Each image must fix its board's pose (`fixes_pose`) by points inside it, all of which the
    narrowest guess can undistort."""
    seen_px = np.concatenate(points_px).ravel()

    def off_px(unknowns: np.ndarray) -> np.ndarray:
        return _projected(unknowns, points_m)[0] - seen_px

    starts = [_start(np.deg2rad(across), points_m, points_px, size_px) for across in GUESSES_DEG]
    best = min((start for start in starts if start is not None), key=lambda x: np.abs(off_px(x)).mean())
    found = least_squares(
        off_px, best, jac=lambda x: _projected(x, points_m)[1], x_scale="jac", max_nfev=MAX_ITERATIONS
    )
    scale = np.linalg.norm(found.jac, axis=0)
    normal = (found.jac / scale).T @ (found.jac / scale)
    variance = 2 * found.cost / (len(seen_px) - len(best)) * np.linalg.inv(normal).diagonal() / scale**2
    focal_std = float(np.max(np.sqrt(variance[:2]) / found.x[:2]))
    turns = list(found.x[LENS:].reshape(-1, 6)[:, :3])
    return FisheyeFit(_lens(name, found.x, size_px), turns, focal_std, float(np.sqrt(4 * found.cost / len(seen_px))))


def _start(
    across: float, points_m: Sequence[np.ndarray], points_px: Sequence[np.ndarray], size_px: tuple[int, int]
) -> np.ndarray | None:
    """Return the unknowns for an equidistant lens of this angle across the longer side; None if an image is beyond what
    it can undistort. Each board's pose is found in the image of a pinhole camera that looks at it."""
    focal_px, (cx, cy) = max(size_px) / across, (np.array(size_px) - 1) / 2
    unknowns = [focal_px, focal_px, cx, cy, 0.0, 0.0, 0.0, 0.0]
    guess = _lens("", np.array(unknowns), size_px)
    for board, seen in zip(points_m, points_px, strict=True):
        straight = undistort_points(seen, guess)
        known = np.isfinite(straight[:, 0])
        if not fixes_pose(board, known):
            return None
        rays = np.column_stack([straight[known], np.ones(known.sum())]) @ np.linalg.inv(guess.K).T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        towards = Rotation.align_vectors([[0, 0, 1]], [rays.mean(0)])[0]
        ahead = towards.apply(rays)
        _, turn, shift = cv2.solvePnP(board[known], ahead[:, :2] / ahead[:, 2:], np.eye(3), None)
        turned = towards.inv() * Rotation.from_rotvec(turn.ravel())
        unknowns += [*turned.as_rotvec(), *towards.inv().apply(shift.ravel())]
    return np.array(unknowns)


def _lens(name: str, unknowns: np.ndarray, size_px: tuple[int, int]) -> Lens:
    fx, fy, cx, cy = unknowns[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return Lens(name, K, unknowns[4:LENS], np.eye(3), np.zeros(3), size_px, fisheye=True)


def _projected(unknowns: np.ndarray, points_m: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels of all points, flat (2 N,), and their derivatives by the unknowns (2 N, unknowns)."""
    lens, pixels, derivatives = _lens("", unknowns, (1, 1)), [], []
    for i, (board, pose) in enumerate(zip(points_m, unknowns[LENS:].reshape(-1, 6), strict=True)):
        at_px, by_all = cv2.fisheye.projectPoints(board[:, None], pose[:3], pose[3:], lens.K, lens.distortion)
        rows = np.zeros((2 * len(board), len(unknowns)))
        rows[:, :LENS] = by_all[:, :LENS]
        rows[:, LENS + 6 * i : LENS + 6 * i + 6] = by_all[:, LENS : LENS + 6]
        pixels.append(at_px.ravel())
        derivatives.append(rows)
    return np.concatenate(pixels), np.concatenate(derivatives)

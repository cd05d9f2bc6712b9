"""First poses of cameras from one person's keypoints: an essential matrix of two cameras, then camera by camera.

The keypoints of all frames form one point cloud, because static, synchronised cameras cannot tell a moving person from
many people (wand calibration, with the person as the wand).
"""

import dataclasses
import logging
from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

import cv2
import numpy as np

from hnerf.calibration.bundle import adjust
from hnerf.calibration.diagnosis import median_height_px, trimmed_cost_px
from hnerf.errors import InputError
from hnerf.evenly_spaced import evenly_spaced
from hnerf.geometry.camera import Camera
from hnerf.geometry.triangulation import triangulate
from hnerf.pycolmap_import import pycolmap

INLIER_SHARE = 0.02  # of the person's height in pixels: about twice a detector's noise
MIN_SHARED = 100  # keypoints that two cameras see at once: four whole people
MIN_ANGLE_DEG = 5.0  # between the rays of two cameras: below it depth is ten times less certain than lateral position
START_FRAMES = 30  # evenly spaced frames in which the first poses are found
STARTS = 2  # pairs from each of which a rig is built; the best rig is kept
TRIALS = 500  # of RANSAC, for one camera against known points

log = logging.getLogger("hnerf.calibration")


class _Pair(NamedTuple):
    """Two cameras with their relative pose; agreeing: number of keypoints that fit it; angle_deg: median angle of their
    rays."""

    cameras: tuple[Camera, Camera]
    agreeing: int
    angle_deg: float


def first_poses(cameras: Sequence[Camera], keypoints: np.ndarray) -> list[Camera]:
    """Return the cameras, whose intrinsics are known at least roughly, with poses up to a similarity transform.

    keypoints (C, frames, 25, 3) of one person. Raises InputError if they do not link all cameras, whatever the starting
    pair, or if all cameras look from one direction.
    """
    pycolmap.logging.minloglevel = 2  # errors only: Ceres otherwise logs every step that it rejects
    chosen = keypoints[:, evenly_spaced(range(keypoints.shape[1]), START_FRAMES)]
    _check_shared(cameras, keypoints)
    inlier_px = INLIER_SHARE * median_height_px(keypoints)
    pairs = {
        (i, j): found
        for i, j in combinations(range(len(cameras)), 2)
        if (found := _relative_pose(cameras[i], cameras[j], keypoints[[i, j]], inlier_px))
    }
    wide = {ij: pair for ij, pair in pairs.items() if pair.angle_deg >= MIN_ANGLE_DEG}
    if not wide:
        widest = max((pair.angle_deg for pair in pairs.values()), default=0.0)
        raise InputError(
            f"the cameras see the person from one direction (at most {widest:.1f} degrees apart), which gives no "
            "depth; place them around the person"
        )
    starts = sorted(wide, key=lambda ij: wide[ij].agreeing, reverse=True)[:STARTS]
    for seen in (chosen, keypoints):  # few frames may miss the moments that a camera shares with others
        rigs, failures = [], []
        for ij in starts:
            try:
                rigs.append(_add_cameras(cameras, seen, ij, wide[ij], inlier_px))
            except InputError as error:
                failures.append(error)
        if rigs:
            return min(rigs, key=lambda rig: trimmed_cost_px(rig, seen))
    raise failures[0]


def _check_shared(cameras: Sequence[Camera], keypoints: np.ndarray) -> None:
    """Raise InputError naming a camera that shares too few keypoints with every other one."""
    seen = (keypoints[..., 2] > 0).reshape(len(cameras), -1).astype(int)
    shared = seen @ seen.T
    for i, camera in enumerate(cameras):
        most = int(np.delete(shared[i], i).max())
        if most < MIN_SHARED:
            raise InputError(
                f"camera {camera.name} shares at most {most} keypoints with another one, and needs {MIN_SHARED}; let "
                "two cameras see the person at once, or leave this one out"
            )


def _relative_pose(a: Camera, b: Camera, keypoints: np.ndarray, inlier_px: float) -> _Pair | None:
    """Return two cameras, the first at the origin, posed by the essential matrix that most keypoints (2, frames, 25, 3)
    fit; None if there is none (Nister 2004, five points, in LO-RANSAC)."""
    both = (keypoints[..., 2] > 0).all(0)
    if both.sum() < MIN_SHARED:
        return None
    in_a, in_b = keypoints[0][both][:, :2], keypoints[1][both][:, :2]
    options = pycolmap.RANSACOptions(max_error=inlier_px, random_seed=0)
    found = pycolmap.estimate_essential_matrix(in_a, in_b, _colmap(a), _colmap(b), options)
    if not found:
        return None
    pose = found["cam2_from_cam1"]
    posed = (
        dataclasses.replace(a, R=np.eye(3), t_m=np.zeros(3)),
        dataclasses.replace(b, R=pose.rotation.matrix(), t_m=np.array(pose.translation)),
    )
    return _Pair(posed, int(found["inlier_mask"].sum()), _angle_deg(posed, keypoints))


def _colmap(camera: Camera) -> pycolmap.Camera:
    """Return the intrinsics, with pixel centres where `camera` has them."""
    params = [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]]
    return pycolmap.Camera(model="PINHOLE", width=camera.width_px, height=camera.height_px, params=params)


def _angle_deg(cameras: tuple[Camera, Camera], keypoints: np.ndarray) -> float:
    """Return the median angle in degrees between the lines from points to two cameras. Lines have no direction, so that
    cameras that face each other count as if they were side by side."""
    points_m, _, _ = triangulate(cameras, keypoints)
    rays = np.stack([points_m - camera.centre_m for camera in cameras])
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True))[:, np.isfinite(points_m).all(-1)]
    cosines = np.abs((rays[0] * rays[1]).sum(-1)).clip(0, 1)
    return float(np.rad2deg(np.arccos(np.median(cosines)))) if cosines.size else 0.0


def _add_cameras(
    cameras: Sequence[Camera], keypoints: np.ndarray, first: tuple[int, int], pair: _Pair, inlier_px: float
) -> list[Camera]:
    """Return all cameras, posed one by one against the points of those before, each time the one that agrees most."""
    rig = dict(zip(first, pair.cameras, strict=True))
    while True:
        known = sorted(rig)
        adjusted = adjust([rig[i] for i in known], keypoints[known], [rig[i].name for i in known])
        rig = dict(zip(known, adjusted, strict=True))
        if len(rig) == len(cameras):
            return [rig[i] for i in known]
        points_m, _, _ = triangulate(adjusted, keypoints[known])
        tried = {
            i: _resection(camera, points_m, keypoints[i], inlier_px) for i, camera in enumerate(cameras) if i not in rig
        }
        best = max(tried, key=lambda i: tried[i][1])
        if tried[best][1] < MIN_SHARED // 2:
            raise InputError(
                f"camera {cameras[best].name} sees nothing that fits the other cameras; check that the recordings are "
                "of one moment and show the same person, or leave it out"
            )
        rig[best] = tried[best][0]


def _resection(camera: Camera, points_m: np.ndarray, keypoints: np.ndarray, inlier_px: float) -> tuple[Camera, int]:
    """Return the camera posed against known points (..., 3) that it sees at keypoints (..., 3), and how many fit
    (SQPnP, Terzakis and Lourakis 2020, or, for a person so far away that it refuses, EPnP, in RANSAC)."""
    use = (keypoints[..., 2] > 0) & np.isfinite(points_m).all(-1)
    if use.sum() < MIN_SHARED // 2:
        return camera, 0

    def solve(method: int) -> Any:
        return cv2.solvePnPRansac(
            points_m[use], keypoints[use, :2], camera.K, None, iterationsCount=TRIALS,
            reprojectionError=2 * inlier_px, flags=method,
        )  # fmt: skip

    try:
        ok, turn, shift, inliers = solve(cv2.SOLVEPNP_SQPNP)
    except cv2.error:
        ok, turn, shift, inliers = solve(cv2.SOLVEPNP_EPNP)
    if not ok or inliers is None:
        return camera, 0
    return dataclasses.replace(camera, R=cv2.Rodrigues(turn)[0], t_m=shift.ravel()), len(inliers)

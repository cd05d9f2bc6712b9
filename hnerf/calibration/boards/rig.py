"""Camera poses from a common board: relative poses of pairs, chained, then adjusted together."""

import dataclasses
from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from hnerf.calibration.boards.bundle import Adjustment, BoardFit, Poses
from hnerf.capture.board_footage import BoardCorners
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera

MIN_CORNERS = 6  # that an image must show to be used: they give 12 numbers for the pose of a plane
FLATNESS_PX = 1.0  # by which a corner may be off the plane of the others in its image
MIN_SHARED = 3  # frames in which two cameras must both see the board
FAR_PX = 100.0  # cap of a corner's error, so that a camera that is far off does not determine the board's pose

Pose = tuple[np.ndarray, np.ndarray]  # R (3, 3), t_m (3,)
Views = dict[tuple[int, int], Pose]  # camera from board, by (camera, frame)


def fixes_pose(corners_m: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return whether the corners `seen` (..., N) bool determine a pose, (...,) bool: enough of them, with two or more
    in each of two rows."""
    rows = np.unique(corners_m[:, 1])
    in_row = np.stack([seen[..., corners_m[:, 1] == row].sum(-1) for row in rows], -1)
    return (seen.sum(-1) >= MIN_CORNERS) & ((in_row >= 2).sum(-1) >= 2)


def planar_corners(corners: BoardCorners) -> BoardCorners:
    """Return corners without those off the plane of the others in their image, and without images whose corners no
    longer determine a pose.

    The undistorted corners of a board are a homography of the flat ones, whatever the cameras' poses.
    """
    corners_m, corners_px = corners.corners_m, corners.corners_px
    kept = np.full_like(corners_px, np.nan)
    for picture in zip(*np.nonzero(fixes_pose(corners_m, np.isfinite(corners_px[..., 0]))), strict=True):
        seen = np.isfinite(corners_px[picture][:, 0])
        _, inlier = cv2.findHomography(corners_m[seen, :2], corners_px[picture][seen], cv2.RANSAC, FLATNESS_PX)
        flat = seen.copy()
        flat[seen] = inlier is not None and inlier.ravel() > 0
        if fixes_pose(corners_m, flat):
            kept[picture][flat] = corners_px[picture][flat]
    return dataclasses.replace(corners, corners_px=kept)


def largest_linked_group(corners: BoardCorners) -> list[str]:
    """Return the largest group of cameras that are linked by shared views of the board, as `planar_corners` left
    them."""
    found = np.isfinite(corners.corners_px[..., 0]).any(-1).astype(int)
    _, group = connected_components(found @ found.T >= MIN_SHARED)
    largest = np.bincount(group, minlength=1).argmax()
    return [name for name, number in zip(corners.cameras, group, strict=True) if number == largest]


def solve_rig(cameras: Sequence[Camera], corners: BoardCorners) -> BoardFit:
    """Solve for the poses of cameras with known intrinsics, from `planar_corners`; the first camera defines the world.
    Raises InputError if the board does not link them."""
    linked = largest_linked_group(corners)
    if alone := ", ".join(name for name in corners.cameras if name not in linked):
        raise InputError(
            f"calibration/extrinsic: camera {alone}: shares fewer than {MIN_SHARED} frames of the board with the other "
            "cameras; film it where two cameras can see it simultaneously"
        )
    views = _view_poses(cameras, corners)
    cameras = _chain_poses(cameras, views)
    moving = [i > 0 for i in range(len(cameras))]
    return Adjustment(cameras, corners, _board_poses(cameras, corners, views), moving).solve()


def solve_boards(cameras: Sequence[Camera], corners: BoardCorners) -> BoardFit:
    """Solve as `solve_rig` does, with fixed cameras."""
    boards = _board_poses(cameras, corners, _view_poses(cameras, corners))
    return Adjustment(cameras, corners, boards, [False] * len(cameras)).solve()


def compare_pairs(cameras: Sequence[Camera], others: Sequence[Camera]) -> dict[str, dict[str, float]]:
    """Return how the relative pose of each pair differs between two calibrations of the same cameras: by "a-b", the
    angle in degrees, and the distance in cm between b's two centres in a's frame."""
    pairs = {}
    for i, j in combinations(range(len(cameras)), 2):
        (R, t_m), (other_R, other_t_m) = (
            _relative_pose(*((c.R, c.t_m) for c in (rig[i], rig[j]))) for rig in (cameras, others)
        )
        turned_deg = np.rad2deg(np.linalg.norm(cv2.Rodrigues(R @ other_R.T)[0]))
        moved_cm = 100 * np.linalg.norm(R.T @ t_m - other_R.T @ other_t_m)
        pairs[f"{cameras[i].name}-{cameras[j].name}"] = {"turned_deg": float(turned_deg), "moved_cm": float(moved_cm)}
    return pairs


def _view_poses(cameras: Sequence[Camera], corners: BoardCorners) -> Views:
    """Return the board pose in each image that `planar_corners` kept."""
    poses: Views = {}
    seen = np.isfinite(corners.corners_px[..., 0])
    for i, f in zip(*np.nonzero(seen.any(-1)), strict=True):
        points = corners.corners_m[seen[i, f]], corners.corners_px[i, f, seen[i, f]], cameras[i].K, None
        _, turn, shift = cv2.solvePnP(*points, flags=cv2.SOLVEPNP_IPPE)
        turn, shift = cv2.solvePnPRefineLM(*points, turn, shift)
        poses[int(i), int(f)] = cv2.Rodrigues(turn)[0], shift.ravel()
    return poses


def _chain_poses(cameras: Sequence[Camera], views: Views) -> list[Camera]:
    """Return camera poses chained over the spanning tree of the pairs that share most frames; the first camera defines
    the world."""
    count = len(cameras)
    shared = {(i, j): [f for (k, f) in views if k == i and (j, f) in views] for i, j in combinations(range(count), 2)}
    cost = np.zeros((count, count))
    for pair, frames in shared.items():
        cost[pair] = 1 / len(frames) if len(frames) >= MIN_SHARED else 0  # 0: no edge
    order, parents = breadth_first_order(minimum_spanning_tree(cost), 0, directed=False)
    posed = [dataclasses.replace(cameras[0], R=np.eye(3), t_m=np.zeros(3)), *cameras[1:]]
    for j in order[1:]:
        parent = posed[parents[j]]
        frames = shared[min(j, parents[j]), max(j, parents[j])]
        R, t_m = _robust_pose([_relative_pose(views[parents[j], f], views[j, f]) for f in frames])
        posed[j] = dataclasses.replace(cameras[j], R=R @ parent.R, t_m=R @ parent.t_m + t_m)
    return posed


def _robust_pose(steps: list[Pose]) -> Pose:
    """Return the medoid of the rotations (least sum of angles to the others) and the median translation of the half
    closest to it."""
    R, t_m = np.stack([step[0] for step in steps]), np.stack([step[1] for step in steps])
    cosines = (np.einsum("aij,bij->ab", R, R) - 1) / 2
    angles = np.arccos(np.clip(cosines, -1, 1))
    best = int(angles.sum(1).argmin())
    near = angles[best] <= np.median(angles[best])
    return R[best], np.median(t_m[near], axis=0)


def _board_poses(cameras: Sequence[Camera], corners: BoardCorners, views: Views) -> Poses:
    """Return the board pose in the world for each frame: of the poses that single cameras give, the one that fits all
    cameras best."""
    frames = len(corners.frames)
    R, t_m, best_px = np.tile(np.eye(3), (frames, 1, 1)), np.zeros((frames, 3)), np.full(frames, np.inf)
    for (i, f), (view_R, view_t_m) in views.items():
        world_R = cameras[i].R.T @ view_R
        world_t_m = cameras[i].R.T @ (view_t_m - cameras[i].t_m)
        points = corners.corners_m @ world_R.T + world_t_m
        seen_px = corners.corners_px[:, f]
        errors_px = [np.linalg.norm(c.project(points)[0] - px, axis=-1) for c, px in zip(cameras, seen_px, strict=True)]
        total_px = np.nansum(np.minimum(errors_px, FAR_PX))
        if total_px < best_px[f]:
            R[f], t_m[f], best_px[f] = world_R, world_t_m, total_px
    return Poses(R, t_m)


def _relative_pose(a: Pose, b: Pose) -> Pose:
    """Return the transform b from a, given both from a third frame."""
    R = b[0] @ a[0].T
    return R, b[1] - R @ a[1]

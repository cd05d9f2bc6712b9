"""Bundle adjustment of cameras, board poses and exposure times to the corners of a moving board.

Cameras without a common shutter see a moving board at times that differ by up to a frame, and differently in every
frame; corners are then off by many pixels, always along the board's path. So each image has a time offset of its own,
and the board moves between frames as a rigid body. A board at rest does not depend on the offsets.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from hnerf.capture.board_footage import BoardCorners
from hnerf.capture.timing import median_step
from hnerf.geometry.camera import Camera

LOSS_SCALE_PX = 0.5  # larger residuals count linearly, not quadratically (soft L1)
FRAMES_PER_PX = 0.1  # a time offset of this many frames costs as much as a corner one pixel off
MAX_OFFSET_FRAMES = 1.0  # cameras that start together differ by no more
MAX_APART = 1.5  # median distances of frame numbers, up to which two frames are neighbours
MAX_ITERATIONS = 60
COST_TOLERANCE = 1e-4  # relative; cameras then change by less than a thousandth of a degree


@dataclass(frozen=True)
class Poses:
    """Board poses in the world by frame: R (F, 3, 3), t_m (F, 3), world from board; identity where not seen."""

    R: np.ndarray
    t_m: np.ndarray


@dataclass(frozen=True)
class BoardFit:
    """Result of the adjustment. seen_px (C, F, N, 2): the corners used, undistorted, NaN where there are none;
    projected_px: all corners of the images that show some; offsets_frames (C, F): exposure time of an image relative to
    its frame's common time."""

    cameras: list[Camera]
    boards: Poses
    seen_px: np.ndarray
    projected_px: np.ndarray
    offsets_frames: np.ndarray

    @property
    def residuals_px(self) -> np.ndarray:
        """Return projected minus seen corners (C, F, N, 2), NaN where not seen."""
        return self.projected_px - self.seen_px

    def error_px(self, camera: int | None = None) -> np.ndarray:
        """Return the distances (n,) of all corners seen by one camera, or by all."""
        residuals_px = self.residuals_px if camera is None else self.residuals_px[camera]
        found = np.linalg.norm(residuals_px, axis=-1).ravel()
        return found[np.isfinite(found)]


class Adjustment:
    """A robust least-squares problem over board poses, time offsets, and the cameras that are `moving`. Unknowns in one
    vector: 6 per camera, 6 per frame (rotation, then translation), 1 per image that shows the board.

    cameras: those of the corners, in their order. Offsets are in frames of the footage; numbers of frames tell where
    some are missing. Rotations are updated on the left, R <- exp(w) R (Triggs et al. 2000, Bundle Adjustment, section
    2.2).
    """

    def __init__(self, cameras: Sequence[Camera], corners: BoardCorners, boards: Poses, moving: Sequence[bool]) -> None:
        self.cameras, self.corners, self.boards, self.moving = cameras, corners, boards, np.asarray(moving)
        self.seen = np.isfinite(corners.corners_px[..., 0])  # (C, F, N)
        self.camera, self.frame = np.nonzero(self.seen.any(-1))  # of each image
        self.picture, self.corner = np.nonzero(self.seen[self.camera, self.frame])  # of each observation
        self.observed_px = corners.corners_px[self.camera, self.frame][self.picture, self.corner]
        self.K = np.stack([camera.K for camera in cameras])
        self.before, self.after = _adjacent_frames(self.seen.any((0, 2)), corners.frames)
        count = 6 * (len(cameras) + len(corners.frames))
        self.offsets = slice(count, count + len(self.camera))
        self.size = self.offsets.stop

    def solve(self) -> BoardFit:
        """Minimise the cost."""
        limits = np.full(self.size, np.inf)
        limits[self.offsets] = MAX_OFFSET_FRAMES
        solved = least_squares(
            self.residuals,
            np.zeros(self.size),
            bounds=(-limits, limits),
            jac_sparsity=self.sparsity(),
            loss="soft_l1",
            f_scale=LOSS_SCALE_PX,
            x_scale="jac",
            ftol=COST_TOLERANCE,
            max_nfev=MAX_ITERATIONS,
        )
        return self.fit(solved.x)

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Return two residuals per corner in pixels, then one per image for its time offset."""
        R, t_m, boards = self._poses(x)
        uv = self._project(R, t_m, boards, x[self.offsets])[self.picture, self.corner]
        return np.concatenate([(uv - self.observed_px).ravel(), x[self.offsets] / FRAMES_PER_PX])

    def sparsity(self) -> csr_matrix:
        """Return which residual depends on which unknown."""
        count, pictures = len(self.cameras), len(self.camera)
        frames = self.frame, self.before[self.frame], self.after[self.frame]
        blocks = np.stack([self.camera, *(count + frame for frame in frames)], -1)
        columns = (6 * blocks[..., None] + np.arange(6)).reshape(pictures, -1)
        columns = np.concatenate([columns, self.offsets.start + np.arange(pictures)[:, None]], -1)
        of_corners = np.repeat(columns[self.picture], 2, axis=0)
        rows = np.repeat(np.arange(len(of_corners)), columns.shape[1])
        last = len(of_corners) + np.arange(pictures)
        row, column = np.concatenate([rows, last]), np.concatenate([of_corners.ravel(), columns[:, -1]])
        return csr_matrix((np.ones(len(row), bool), (row, column)), shape=(last[-1] + 1, self.size))

    def fit(self, x: np.ndarray) -> BoardFit:
        """Return the unknowns as cameras, board poses and residuals."""
        R, t_m, boards = self._poses(x)
        cameras = [
            dataclasses.replace(camera, R=R[i], t_m=t_m[i]) if self.moving[i] else camera
            for i, camera in enumerate(self.cameras)
        ]
        offsets_frames = np.full(self.seen.shape[:2], np.nan)
        offsets_frames[self.camera, self.frame] = x[self.offsets]
        projected_px = np.full_like(self.corners.corners_px, np.nan)
        projected_px[self.camera, self.frame] = self._project(R, t_m, boards, x[self.offsets])
        return BoardFit(cameras, boards, self.corners.corners_px, projected_px, offsets_frames)

    def _poses(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, Poses]:
        """Return R (C, 3, 3) and t_m (C, 3) of the cameras, and the board poses."""
        steps = x[: self.offsets.start].reshape(-1, 6)
        of_cameras = steps[: len(self.cameras)] * self.moving[:, None]
        of_boards = steps[len(self.cameras) :]
        R = _exp(of_cameras[:, :3]) @ np.stack([camera.R for camera in self.cameras])
        t_m = of_cameras[:, 3:] + np.stack([camera.t_m for camera in self.cameras])
        return R, t_m, Poses(_exp(of_boards[:, :3]) @ self.boards.R, of_boards[:, 3:] + self.boards.t_m)

    def _project(self, R: np.ndarray, t_m: np.ndarray, boards: Poses, offsets: np.ndarray) -> np.ndarray:
        """Return the pixels (images, N, 2) of all corners."""
        board_R, board_t_m = self._boards_at_picture_time(boards, offsets)
        own = R[self.camera]
        to_camera, shift_m = own @ board_R, (own @ board_t_m[..., None])[..., 0] + t_m[self.camera]
        x = np.einsum("pij,nj->pni", to_camera, self.corners.corners_m) + shift_m[:, None]
        uv = np.einsum("pij,pnj->pni", self.K[self.camera], x)
        return uv[..., :2] / uv[..., 2:]

    def _boards_at_picture_time(self, boards: Poses, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return each image's board pose at the image's own time: the parabola through its frame and the two adjacent
        ones, in translation and in the rotation vector relative to its frame. A missing neighbour mirrors the other
        one."""
        frame, s = self.frame, offsets[:, None] / self.corners.frame_step
        own = np.arange(len(self.before))
        no_before, no_after = (self.before == own)[:, None], (self.after == own)[:, None]
        beside = self.before, self.after
        turned = [Rotation.from_matrix(np.swapaxes(boards.R, -1, -2) @ boards.R[i]).as_rotvec() for i in beside]
        moved = [boards.t_m[i] - boards.t_m for i in beside]
        paths = []
        for to_before, to_after in (turned, moved):
            to_before = np.where(no_before, -to_after, to_before)
            to_after = np.where(no_after, -to_before, to_after)
            paths.append(s * (to_after - to_before)[frame] / 2 + s**2 * (to_after + to_before)[frame] / 2)
        return boards.R[frame] @ _exp(paths[0]), boards.t_m[frame] + paths[1]


def _adjacent_frames(seen: np.ndarray, frames: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the frame before and the frame after each one; the frame itself if that one is missing, or further away
    than neighbours usually are. seen: (F,) bool."""
    own = np.arange(len(seen))
    before, after = np.maximum(own - 1, 0), np.minimum(own + 1, len(seen) - 1)
    number, apart = np.asarray(frames), MAX_APART * median_step(frames)
    near_before, near_after = number - number[before] <= apart, number[after] - number <= apart
    return np.where(seen[before] & near_before, before, own), np.where(seen[after] & near_after, after, own)


def _exp(vectors: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(vectors).as_matrix()

"""A calibrated pinhole camera, and nothing about file formats.

Conventions, used everywhere past the capture adapters: x_camera = R x_world + t, metres, OpenCV axes (x right, y down,
z forward), pixel centres at integer coordinates, linear model (images are undistorted at the door).
"""

import dataclasses
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels, extrinsics world to camera in metres.

    K: (3, 3) float64; R: (3, 3) float64 rotation; t_m: (3,) float64; width_px, height_px: image size.
    """

    name: str
    K: np.ndarray
    R: np.ndarray
    t_m: np.ndarray
    width_px: int
    height_px: int

    @property
    def centre_m(self) -> np.ndarray:
        """Camera centre in the world, (3,)."""
        return -self.R.T @ self.t_m

    @property
    def forward(self) -> np.ndarray:
        """Unit viewing direction in the world, (3,)."""
        return self.R[2]

    @property
    def projection(self) -> np.ndarray:
        """P = K [R | t], (3, 4)."""
        return self.K @ np.hstack([self.R, self.t_m[:, None]])

    def project(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points (..., 3) to pixels (..., 2) and depths (...,) in metres; depth <= 0 is behind the camera."""
        x = points_m @ self.R.T + self.t_m
        depth_m = x[..., 2]
        uv = x @ self.K.T
        with np.errstate(divide="ignore", invalid="ignore"):
            return uv[..., :2] / uv[..., 2:], depth_m

    def rays(self, pixels_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (..., 2) as (x, y) to ray origins and unit directions in the world, both (..., 3)."""
        homogeneous = np.concatenate([pixels_px, np.ones_like(pixels_px[..., :1])], axis=-1)
        directions = homogeneous @ np.linalg.inv(self.K).T @ self.R
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return np.broadcast_to(self.centre_m, directions.shape), directions

    def resized(self, width_px: int, height_px: int) -> "Camera":
        """The same camera with its image resampled to another size (pixel centres at integers)."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        K = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]]) @ self.K
        return Camera(self.name, K, self.R, self.t_m, width_px, height_px)


def look_at(like: Camera, centre_m: np.ndarray, target_m: np.ndarray, up: np.ndarray) -> Camera:
    """The camera `like`, moved to `centre_m` and turned to see `target_m` in the middle of its image; `up` (3,) is
    upwards in the image."""
    forward = (target_m - centre_m) / np.linalg.norm(target_m - centre_m)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    K = like.K.copy()
    K[:2, 2] = (like.width_px - 1) / 2, (like.height_px - 1) / 2
    return dataclasses.replace(like, K=K, R=R, t_m=-R @ centre_m)

"""Calibrated pinhole cameras, independent of file formats.

Conventions, used everywhere after the capture adapters: x_camera = R x_world + t, metres, OpenCV axes (x right, y down,
z forward), pixel centres at integer coordinates, linear model (images are undistorted when they are ingested).
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True)
class Camera:
    """A calibrated pinhole camera: intrinsics in pixels, extrinsics from world to camera in metres.

    R: rotation; width_px, height_px: image size.
    """

    name: str
    K: Float[np.ndarray, "3 3"]
    R: Float[np.ndarray, "3 3"]
    t_m: Float[np.ndarray, "3"]
    width_px: int
    height_px: int

    @property
    def centre_m(self) -> Float[np.ndarray, "3"]:
        """Return the camera centre in the world."""
        return -self.R.T @ self.t_m

    @property
    def forward(self) -> Float[np.ndarray, "3"]:
        """Return the unit viewing direction in the world."""
        return self.R[2]

    @property
    def projection(self) -> Float[np.ndarray, "3 4"]:
        """Return the projection matrix P = K [R | t]."""
        return self.K @ np.hstack([self.R, self.t_m[:, None]])

    def project(self, points_m: Float[np.ndarray, "*S 3"]) -> tuple[Float[np.ndarray, "*S 2"], Float[np.ndarray, "*S"]]:
        """Project world points to pixels and depths in metres; a depth <= 0 lies behind the camera."""
        x = points_m @ self.R.T + self.t_m
        depth_m = x[..., 2]
        uv = x @ self.K.T
        with np.errstate(divide="ignore", invalid="ignore"):
            return uv[..., :2] / uv[..., 2:], depth_m

    def holds(self, pixels_px: Float[np.ndarray, "*S 2"]) -> Bool[np.ndarray, "*S"]:
        """Return whether points (x, y) lie in the image, which extends half a pixel beyond the centres of its outer
        pixels; False for NaN."""
        (x, y), (width_px, height_px) = np.moveaxis(pixels_px, -1, 0), self.size_px
        return (x >= -0.5) & (x <= width_px - 0.5) & (y >= -0.5) & (y <= height_px - 0.5)

    def rays(self, pixels_px: Float[np.ndarray, "*S 2"]) -> tuple[Float[np.ndarray, "*S 3"], Float[np.ndarray, "*S 3"]]:
        """Return the rays through pixels, given as (x, y): origins and unit directions in the world."""
        homogeneous = np.concatenate([pixels_px, np.ones_like(pixels_px[..., :1])], axis=-1)
        directions = homogeneous @ np.linalg.inv(self.K).T @ self.R
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return np.broadcast_to(self.centre_m, directions.shape), directions

    @property
    def size_px(self) -> tuple[int, int]:
        """Return the image's (width, height)."""
        return self.width_px, self.height_px

    @property
    def pixels_px(self) -> Float[np.ndarray, "H W 2"]:
        """Return the (x, y) of every pixel of the image."""
        return np.stack(np.meshgrid(np.arange(self.width_px), np.arange(self.height_px)), -1).astype(np.float64)

    def resized(self, width_px: int, height_px: int) -> "Camera":
        """Return this camera with its image resampled to another size (pixel centres at integers)."""
        sx, sy = width_px / self.width_px, height_px / self.height_px
        return Camera(self.name, resampling(sx, sy) @ self.K, self.R, self.t_m, width_px, height_px)

    def scaled(self, share: float | int) -> "Camera":
        """Return this camera with each side of its image scaled by `share`, to at least one pixel."""
        return self.resized(max(1, round(share * self.width_px)), max(1, round(share * self.height_px)))


def resampling(sx: float, sy: float, left_px: float | int = 0.0, top_px: float | int = 0.0) -> Float[np.ndarray, "3 3"]:
    """Return the matrix that maps pixels of an image to pixels of another into which it is pasted: scaled by sx and sy,
    with its top left corner left_px and top_px from the other's. Pixel centres are at integers, so corners are at
    -0.5."""
    return np.array([[sx, 0, left_px + (sx - 1) / 2], [0, sy, top_px + (sy - 1) / 2], [0, 0, 1]])


def look_at(like: Camera, centre_m: np.ndarray, target_m: np.ndarray, up: np.ndarray) -> Camera:
    """Return the camera `like` moved to `centre_m` and rotated so that `target_m` is at the centre of its image; `up`
    (3,) points upwards in the image."""
    forward = (target_m - centre_m) / np.linalg.norm(target_m - centre_m)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    K = like.K.copy()
    K[:2, 2] = (like.width_px - 1) / 2, (like.height_px - 1) / 2
    return dataclasses.replace(like, K=K, R=R, t_m=-R @ centre_m)

"""Points seen by cameras, and the robust least-squares term of their reprojection."""

from dataclasses import dataclass

import torch
from torch import Tensor

from hnerf.body.normal_equations import geman_mcclure
from hnerf.geometry.camera import Camera

NEAR_M = 0.1  # least depth: nothing nearer is in a camera's image

DataTerm = tuple[Tensor, Tensor, float]  # each point's matrix (n, K, 3, 3) and gradient (n, K, 3), and the cost


@dataclass(frozen=True)
class Views:
    """K points in n frames as C cameras see them: pixels (C, n, K, 2) and confidence (C, n, K), 0 where unseen."""

    cameras: tuple[Camera, ...]
    pixels: Tensor
    confidence: Tensor

    def select(self, points: list[int]) -> "Views":
        """Return the views of some of the points."""
        return Views(self.cameras, self.pixels[..., points, :], self.confidence[..., points])


def project(camera: Camera, x: Tensor) -> tuple[Tensor, Tensor]:
    """Return pixels (..., 2) of world points, and their derivative with respect to the points (..., 2, 3)."""
    projection = torch.from_numpy(camera.projection)
    h = x @ projection[:, :3].T + projection[:, 3]
    depth = h[..., 2:].clamp(min=NEAR_M)
    uv = h[..., :2] / depth
    return uv, (projection[:2, :3] - uv[..., None] * projection[2, :3]) / depth[..., None]


def reprojection_term(views: Views, scale_m: Tensor, x: Tensor, std_m: float, outlier_m: float) -> DataTerm:
    """Return the data term of points x (n, K, 3) against their views, with pixel residuals converted to metres.

    scale_m (C, n): metres a pixel spans; std_m: standard deviation of a point seen with full confidence; outlier_m: see
    `geman_mcclure`.
    """
    matrix = torch.zeros(*x.shape, 3, dtype=x.dtype)
    pull, cost = torch.zeros_like(x), 0.0
    for camera, scale, pixels, confidence in zip(views.cameras, scale_m, views.pixels, views.confidence, strict=True):
        uv, by_x = project(camera, x)
        residual = (uv - pixels) * scale[:, None, None]
        by_x = by_x * scale[:, None, None, None]
        weight, part = geman_mcclure(residual.square().sum(-1), std_m, outlier_m)
        trust = confidence.square()
        matrix += torch.einsum("nk,nkic,nkid->nkcd", trust * weight, by_x, by_x)
        pull += torch.einsum("nk,nkic,nki->nkc", trust * weight, by_x, residual)
        cost += float((trust * part).sum())
    return matrix, pull, cost

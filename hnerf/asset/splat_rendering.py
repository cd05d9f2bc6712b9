"""A plain renderer of Gaussian splats by the equations of 3D Gaussian Splatting (Kerbl et al. 2023).

The published program also adds 0.3 px² to each spread, which thickens outlines where splats are smaller than pixels.
Here the caller renders at a finer resolution instead.
"""

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from hnerf.geometry.camera import Camera

NEAREST_M = 0.05  # splats nearer to the camera are left out
FAINTEST = 1 / 255  # least opacity that is drawn
MOST_AT_ONCE = 1_000_000  # pairs of a splat and a pixel


def render_splats(
    middles_m: np.ndarray,
    quaternions: np.ndarray,
    scales_m: np.ndarray,
    opacity: float,
    colours: np.ndarray,
    camera: Camera,
) -> np.ndarray:
    """Return an image of splats (H, W, 4): colours over black and the coverage, from 0 to 1.

    middles_m (N, 3), quaternions (N, 4) as w x y z, colours (N, 3); scales_m (3,) and opacity are shared by all. From
    front to back, a splat adds c alpha times what those in front of it let through, the product of their 1 - alpha (eq.
    3).
    """
    ahead = camera.project(middles_m)[1] > NEAREST_M
    middles_px, depth_m = camera.project(middles_m[ahead])
    spreads_px2 = projected(middles_m[ahead], covariances(quaternions[ahead], scales_m), camera)
    order = np.argsort(depth_m, kind="stable")
    colours = colours[ahead][order]
    picture, through = np.zeros((camera.width_px * camera.height_px, 4)), np.ones(camera.width_px * camera.height_px)
    for splat, pixel, alpha in _touched(middles_px[order], spreads_px2[order], opacity, camera):
        let = np.log1p(-alpha)
        before = np.cumsum(let) - let
        first = np.flatnonzero(np.diff(pixel, prepend=-1))
        before -= np.repeat(before[first], np.diff(first, append=len(pixel)))
        share = through[pixel] * np.exp(before) * alpha
        added = np.column_stack([share[:, None] * colours[splat], share])
        if len(first):
            picture[pixel[first]] += np.add.reduceat(added, first)
            through[pixel[first]] *= np.exp(np.add.reduceat(let, first))
    return picture.reshape(camera.height_px, camera.width_px, 4)


def covariances(quaternions: np.ndarray, scales_m: np.ndarray) -> np.ndarray:
    """Return R S S^T R^T (N, 3, 3) for rotations by unit quaternions (N, 4), w x y z, and scales (3,) (eq. 6)."""
    axes_m = Rotation.from_quat(quaternions, scalar_first=True).as_matrix() * scales_m
    return axes_m @ axes_m.swapaxes(1, 2)


def projected(middles_m: np.ndarray, covariances_m2: np.ndarray, camera: Camera) -> np.ndarray:
    """Return J W V W^T J^T (N, 2, 2) for covariances V (N, 3, 3), in square pixels: W rotates the world to the camera,
    and J is the Jacobian of the projection at the splats' centres (eq. 5)."""
    pixels_px, depth_m = camera.project(middles_m)
    jacobians = (camera.K[:2] - pixels_px[:, :, None] * camera.K[2]) / depth_m[:, None, None] @ camera.R
    return jacobians @ covariances_m2 @ jacobians.swapaxes(1, 2)


def _touched(
    middles_px: np.ndarray, spreads_px2: np.ndarray, opacity: float, camera: Camera
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield splats, the pixels that they touch, counted row by row, and their alpha there, all (M,), in blocks from
    front to back. Within a block, pixels are sorted, and the splats of each pixel go from front to back."""
    reach = np.sqrt(2 * np.log(opacity / FAINTEST)) * np.sqrt(np.diagonal(spreads_px2, axis1=1, axis2=2))
    low = np.ceil(middles_px - reach).clip(0, camera.size_px).astype(np.int64)
    size = (np.floor(middles_px + reach).clip(-1, np.array(camera.size_px) - 1).astype(np.int64) - low + 1).clip(0)
    counts, forms = size.prod(1), np.linalg.inv(spreads_px2)
    for block in _blocks(counts):
        splat = np.repeat(np.arange(block.start, block.stop), counts[block])
        at = np.arange(len(splat)) - np.repeat(np.cumsum(counts[block]) - counts[block], counts[block])
        xy = low[splat] + np.stack([at % size[splat, 0], at // size[splat, 0]], 1)
        x, y = (xy - middles_px[splat]).T
        form = forms[splat]
        alpha = opacity * np.exp(-(form[:, 0, 0] * x * x + form[:, 1, 1] * y * y) / 2 - form[:, 0, 1] * x * y)
        pixel = xy[:, 1] * camera.width_px + xy[:, 0]
        drawn = np.flatnonzero(alpha >= FAINTEST)
        drawn = drawn[np.argsort(pixel[drawn], kind="stable")]
        yield splat[drawn], pixel[drawn], alpha[drawn]


def _blocks(counts: np.ndarray) -> Iterator[slice]:
    """Yield runs of splats that touch MOST_AT_ONCE pixels in all, or of one that touches more."""
    ends, start = np.cumsum(counts), 0
    while start < len(counts):
        before = ends[start] - counts[start]
        stop = max(start + 1, int(np.searchsorted(ends, before + MOST_AT_ONCE, "right")))
        yield slice(start, stop)
        start = stop

"""Antialiased images of a field: one ray per pixel, and one per quarter of a pixel where neighbours differ."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

MIXED_CONTRAST = 0.1  # between neighbours, of colour or coverage; 0.05 gains 0.01 dB for a quarter more rays
QUARTERS_PX = 0.25 * np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])  # from a pixel's centre to those of its quarters


def antialiased(
    render_rays_at: Callable[[np.ndarray], Tensor],
    render_beside: Callable[[np.ndarray, np.ndarray], Tensor],
    visible: np.ndarray,
) -> Tensor:
    """Return an image (H, W, 5): colour, coverage and depth, 0 outside `visible` (H, W) bool.

    render_rays_at: maps points (N, 2) of the image, (x, y) in pixels, to what their rays see, (N, 5). render_beside:
    the same for these points, each moved by offsets (M, 2) in pixels, (M, N, 5). In mixed pixels, colour and coverage
    are means over four quarters; depth is that of the centre, since a mean of near and far lies on neither surface.
    """
    centres = _pixels(visible)
    seen = render_rays_at(centres)
    image = seen.new_zeros(*visible.shape, 5)
    image[tuple(centres.T[::-1])] = seen
    mixed = _pixels(mixed_pixels(image[..., :4]).cpu().numpy())
    x, y = mixed.T
    image[y, x, :4] = render_beside(mixed, QUARTERS_PX).mean(0)[:, :4]
    return image


def mixed_pixels(image: Tensor) -> Tensor:
    """Return the pixels (H, W) bool of an image (H, W, C) whose 3 x 3 neighbourhood spans more than MIXED_CONTRAST in a
    channel."""
    planes = image.permute(2, 0, 1)[None]
    span = torch.nn.functional.max_pool2d(planes, 3, 1, 1) + torch.nn.functional.max_pool2d(-planes, 3, 1, 1)
    return span[0].amax(0) > MIXED_CONTRAST


def _pixels(where: np.ndarray) -> np.ndarray:
    """Return the (x, y) of the pixels in a mask, (N, 2)."""
    return np.argwhere(where)[:, ::-1]

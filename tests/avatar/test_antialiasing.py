"""Antialiasing: the pixel area covered by a straight edge, worked out by hand."""

import numpy as np
import torch
from torch import Tensor

from hnerf.avatar.antialiasing import antialiased, mixed_pixels

EVERYWHERE = np.ones((3, 5), bool)


def edge_at(x_px: float, asked: list[np.ndarray] | None = None):
    """Return two functions that render a white wall, 1 m away and right of x_px: one for rays at given points, and one
    for rays at offsets from them."""

    def seen(points_px: np.ndarray) -> Tensor:
        if asked is not None:
            asked.append(points_px)
        covered = torch.from_numpy(points_px[:, 0] > x_px).float()[:, None]
        return covered.expand(-1, 5)

    def beside(points_px: np.ndarray, offsets_px: np.ndarray) -> Tensor:
        return seen((offsets_px[:, None] + points_px).reshape(-1, 2)).unflatten(0, (len(offsets_px), len(points_px)))

    return seen, beside


def test_a_pixel_halved_by_an_edge_is_half_covered():
    """With an edge at 2.1 px, the wall covers the right quarters of pixel 2, sampled at 2.25 px, but not its centre."""
    image = antialiased(*edge_at(2.1), EVERYWHERE)
    assert image[1, :, 3].tolist() == [0, 0, 0.5, 1, 1]
    assert image[1, :, 0].tolist() == [0, 0, 0.5, 1, 1]
    assert image[1, :, 4].tolist() == [0, 0, 0, 1, 1]  # depth is that of the pixel's centre


def test_pixels_that_agree_with_their_neighbours_are_cast_once():
    asked: list[np.ndarray] = []
    antialiased(*edge_at(2.1, asked), EVERYWHERE)
    assert [len(points) for points in asked] == [15, 24]  # four quarter samples for each pixel of columns 2 and 3
    assert asked[1].tolist()[0] == [1.75, -0.25]


def test_columns_are_x_and_only_visible_pixels_are_cast():
    visible = np.zeros((3, 5), bool)
    visible[2, 4] = True
    asked: list[np.ndarray] = []
    image = antialiased(*edge_at(-1, asked), visible)
    assert asked[0].tolist() == [[4, 2]]
    assert image[2, 4, 4] == 1 and image[..., 4].sum() == 1


def test_without_visible_pixels_the_image_is_empty():
    assert antialiased(*edge_at(0), np.zeros((3, 5), bool)).abs().sum() == 0


def test_pixels_are_mixed_if_any_channel_differs_by_more_than_a_tenth():
    image = torch.zeros(1, 5, 4)
    image[0, 0, 1], image[0, 4, 3] = 0.09, 0.11
    assert mixed_pixels(image)[0].tolist() == [False, False, False, True, True]

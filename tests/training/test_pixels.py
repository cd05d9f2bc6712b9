"""Which pixels a step draws, and where a recording's edges are."""

from pathlib import Path

import torch

from hnerf.training.pixels import Pixels, gather_pixels
from tests.training.scene import record


def test_a_third_of_the_rays_is_drawn_at_edges():
    """Two frames of four and two pixels; the first pixel of the one is at an edge, and none of the other."""
    number = torch.arange(6)
    edge = torch.tensor([True] + [False] * 5)
    pixels = Pixels(
        starts=torch.tensor([0, 4, 6]),
        edges=torch.tensor([0, 4, 5]),
        edge_starts=torch.tensor([0, 1, 3]),
        camera=torch.zeros(6, dtype=torch.uint8),
        xy_px=number[:, None].expand(6, 2).short(),
        colour=number[:, None].expand(6, 3).to(torch.uint8),
        plate=None,
        person=edge,
        edge=edge,
        rays_from_px=torch.eye(3)[None],
        centres_m=torch.zeros(1, 3),
    )
    rays = pixels.draw(torch.tensor([1, 0]), 300, torch.Generator().manual_seed(0))
    drawn = (255 * rays.colour[:, 0]).round().long().view(2, 300)
    assert rays.frame.tolist() == [1] * 300 + [0] * 300
    assert drawn[0].unique().tolist() == [4, 5]
    assert drawn[1, :100].unique().tolist() == [0]
    assert drawn[1, 100:].unique().tolist() == [0, 1, 2, 3]
    assert 30 < int((drawn[1, 100:] == 0).sum()) < 70  # a quarter of the others, by chance


def test_edges_are_found_in_every_frame(tmp_path: Path):
    capture, masks, body = record(tmp_path)
    pixels = gather_pixels(capture, masks, body, body.frames, 0.2, torch.device("cpu"))
    assert torch.equal(pixels.edges, torch.nonzero(pixels.edge)[:, 0])
    for row in range(len(body.frames)):
        own = pixels.edges[pixels.edge_starts[row] : pixels.edge_starts[row + 1]]
        assert len(own)
        assert ((own >= pixels.starts[row]) & (own < pixels.starts[row + 1])).all()


def test_a_frame_without_edges_offers_all_its_pixels(tmp_path: Path):
    """The person fills every image of the first frame."""
    capture, masks, body = record(tmp_path)
    for camera in capture.train_cameras:
        masks.masks[camera, 0][:] = True
    pixels = gather_pixels(capture, masks, body, body.frames, 0.2, torch.device("cpu"))
    assert torch.equal(pixels.edges[: pixels.edge_starts[1]], torch.arange(int(pixels.starts[1])))

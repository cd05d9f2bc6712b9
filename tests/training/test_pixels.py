"""The pixels that a step draws, where outlines are, and which pixels a body or box can reach."""

import dataclasses
import errno
import functools
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from torch import Tensor

from hnerf.capture.masks import encode
from hnerf.geometry.camera import Camera
from hnerf.geometry.reach import ReachablePixels, everywhere, within_box, within_reach
from hnerf.training import gather
from hnerf.training.gather import gather_pixels
from hnerf.training.pixels import CellErrors, Pixels
from hnerf.training.plates import plates_of
from tests.training.scene import ALONE, SIZE_PX, record

AHEAD = Camera("ahead", np.diag([50.0, 50.0, 1.0]), np.eye(3), np.zeros(3), 60, 40)
AFAR = dataclasses.replace(AHEAD, K=np.diag([5000.0, 5000.0, 1.0]))  # its rays are almost parallel
REACHED = functools.partial(within_reach, reach_m=0.2)


def test_each_frame_gets_its_rays_from_its_own_pixels() -> None:
    """Two frames with four and two pixels."""
    number = torch.arange(6)
    pixels = Pixels(
        starts=torch.tensor([0, 4, 6]),
        image_starts=torch.tensor([0, 4, 6]),
        image_camera=torch.tensor([0, 0]),
        pixel_index=number.int(),
        cell=None,
        colour=number[:, None].expand(6, 3).to(torch.uint8),
        plate=None,
        person=number > 3,
        edge=number > 3,
        widths_px=torch.tensor([3]),
        rays_from_px=torch.eye(3)[None],
        centres_m=torch.zeros(1, 3),
    )
    rays = pixels.draw(torch.tensor([1, 0]), 300, torch.Generator().manual_seed(0))
    drawn = (255 * rays.colour[:, 0]).round().long().view(2, 300)
    assert rays.frame.tolist() == [1] * 300 + [0] * 300
    assert drawn[0].unique().tolist() == [4, 5]
    assert drawn[1].unique().tolist() == [0, 1, 2, 3]
    assert 50 < int((drawn[1] == 0).sum()) < 100  # about a quarter


def test_a_cell_keeps_half_of_its_earlier_error() -> None:
    """Cell 0 sees 0.4, then 0.2; cell 1 sees 0.6 and 0.2 in one step; cell 2 sees nothing."""
    errors = CellErrors(3)
    errors.update(torch.tensor([0, 1, 1], dtype=torch.int32), torch.tensor([0.4, 0.6, 0.2]))
    assert errors.mean.tolist() == pytest.approx([0.2, 0.8 / 3, 0])
    errors.update(torch.tensor([0], dtype=torch.int32), torch.tensor([0.2]))
    assert errors.mean.tolist() == pytest.approx([0.2, 0.8 / 3, 0])


def test_of_four_candidates_the_one_in_the_cell_with_the_largest_error_is_drawn(tmp_path: Path) -> None:
    """A share of a frame's pixels is in cells with an error of 0.2, the rest in cells with 0.1. A cell that no ray has
    met precedes both, but not one whose error was zero."""
    pixels = gather_pixels(*record(tmp_path), REACHED, {}, tmp_path, ALONE)
    errors, generator = CellErrors(int(pixels.cell.max()) + 1), torch.Generator().manual_seed(0)
    of_frame = pixels.cell[: pixels.starts[1]]
    last = of_frame[-1]

    def drawn(chosen: Callable[[Tensor], Tensor]) -> tuple[float, float]:
        """Return the share of draws in the chosen cells, and the share expected if they precede all others."""
        cell = pixels.draw(torch.tensor([0]), 4000, generator, errors).cell
        return float(chosen(cell).double().mean()), 1 - (1 - float(chosen(of_frame).double().mean())) ** 4

    errors.mean[:] = torch.where(torch.arange(len(errors.mean)) % 3 == 0, 0.2, 0.1)
    found, expected = drawn(lambda cell: cell % 3 == 0)
    assert found == pytest.approx(expected, abs=0.03)
    errors.mean[last] = 0
    found, expected = drawn(lambda cell: cell == last)
    assert found == pytest.approx(expected, abs=0.01) and expected > 0.02
    errors.update(last[None], torch.zeros(1))
    assert drawn(lambda cell: cell == last)[0] == 0


def test_cells_are_squares_of_four_pixels_of_an_image(tmp_path: Path) -> None:
    """Numbers are consecutive over images, and only for squares with pixels."""
    pixels = gather_pixels(*record(tmp_path), REACHED, {}, tmp_path, ALONE)
    _, xy_px = pixels.cameras_and_xy(torch.arange(len(pixels.person)))
    image = torch.arange(len(pixels.image_camera)).repeat_interleave(pixels.image_starts.diff())
    wanted = torch.stack([image, xy_px[:, 1] // 4, xy_px[:, 0] // 4], 1)
    _, expected = torch.unique(wanted, dim=0, return_inverse=True)
    assert torch.equal(pixels.cell.long(), expected)


def test_camera_and_position_of_a_pixel_follow_from_its_index() -> None:
    """Images of 3 x 2, 2 x 2 and 3 x 2 pixels from cameras 0, 1 and 0; first with all pixels, then with some."""
    none = torch.zeros(0)
    names = ("starts", "cell", "colour", "plate", "person", "edge", "rays_from_px", "centres_m")
    like = dict.fromkeys(names, none)
    images = {"image_camera": torch.tensor([0, 1, 0]), "widths_px": torch.tensor([3, 2])}
    whole = Pixels(image_starts=torch.tensor([0, 6, 10, 16]), pixel_index=None, **images, **like)
    camera, xy_px = whole.cameras_and_xy(torch.tensor([0, 5, 6, 9, 10, 14]))
    assert camera.tolist() == [0, 0, 1, 1, 0, 0]
    assert xy_px.tolist() == [[0, 0], [2, 1], [0, 0], [1, 1], [0, 0], [1, 1]]
    pixel_index = torch.tensor([0, 1, 2, 3, 4, 5, 2], dtype=torch.int32)  # the second image has no pixels
    some = Pixels(image_starts=torch.tensor([0, 5, 5, 7]), pixel_index=pixel_index, **images, **like)
    camera, xy_px = some.cameras_and_xy(torch.tensor([4, 5, 6]))
    assert camera.tolist() == [0, 0, 0]
    assert xy_px.tolist() == [[1, 1], [2, 1], [2, 0]]


@pytest.mark.parametrize("visible_pixels", [REACHED, None])
def test_gathered_pixels_equal_those_of_the_images(tmp_path: Path, visible_pixels: ReachablePixels | None) -> None:
    """Without a visibility function, all pixels are used."""
    capture, masks, body = record(tmp_path)
    out = tmp_path / "out"
    out.mkdir()
    (out / "plate.pixels").write_bytes(b"of a process that was killed")
    pixels = gather_pixels(capture, masks, body, visible_pixels, {}, out, ALONE)
    assert not any(out.iterdir())
    assert (pixels.pixel_index is None) == (visible_pixels is None)
    camera, xy_px = pixels.cameras_and_xy(torch.arange(len(pixels.person)))
    row = torch.arange(len(body.frames)).repeat_interleave(pixels.starts.diff())
    for c, name in enumerate(capture.train_cameras):
        for r, frame in enumerate(body.frames):
            part = (camera == c) & (row == r)
            x, y = xy_px[part].T.numpy()
            assert len(x) == 32 * 32 if visible_pixels is None else 0 < len(x) < 32 * 32
            assert np.array_equal(pixels.colour[part].numpy(), capture.image(name, frame)[y, x])
            assert np.array_equal(pixels.person[part].numpy(), masks.get(name, frame)[y, x])
            origins_m, directions = pixels.rays(camera[part], xy_px[part])
            centre_m, wanted = capture.cameras[name].rays(xy_px[part].numpy().astype(float))
            np.testing.assert_allclose(directions, wanted, atol=1e-6)
            np.testing.assert_allclose(origins_m, np.broadcast_to(centre_m, wanted.shape), atol=1e-6)
            assert pixels.edge[part].any()


def test_gathering_that_fills_the_disk_leaves_no_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(gather, "_exposure_corrected", Mock(side_effect=full))
    with pytest.raises(OSError, match="No space left"):
        gather_pixels(*record(tmp_path), REACHED, {}, tmp_path / "out", ALONE)
    assert not any((tmp_path / "out").iterdir())


def test_an_image_that_the_body_does_not_reach_has_no_pixels(tmp_path: Path) -> None:
    capture, masks, body = record(tmp_path)
    masks.encoded["1", 0] = encode(np.zeros((SIZE_PX, SIZE_PX), bool))

    def reached(camera: Camera, vertices_m: np.ndarray) -> np.ndarray:
        left = camera.name == "1" and np.array_equal(vertices_m, body.vertices_m()[0])
        return REACHED(camera, vertices_m) & (not left)

    pixels = gather_pixels(capture, masks, body, reached, {}, tmp_path, ALONE)
    assert pixels.plate is not None and pixels.plate.shape == pixels.colour.shape
    assert int(pixels.image_starts.diff()[1]) == 0 < int(pixels.image_starts.diff()[2])


def test_pixels_of_a_mask_are_gathered_where_the_body_does_not_reach(tmp_path: Path) -> None:
    """The fit may be wrong there: the mask alone says which pixels show the person."""
    capture, masks, body = record(tmp_path)
    pixels = gather_pixels(capture, masks, body, lambda *_: np.zeros((SIZE_PX, SIZE_PX), bool), {}, tmp_path, ALONE)
    shown = sum(masks.get(name, frame).sum() for name in capture.train_cameras for frame in body.frames)
    assert pixels.person.all() and len(pixels.person) == shown > 0


def test_outline_pixels_with_an_unknown_background_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The background of one camera is unknown: only its outline pixels are left out, not its other pixels nor those of
    other cameras. A field that models the background needs no plates, and gets all pixels."""
    capture, masks, body = record(tmp_path)
    every = gather_pixels(capture, masks, body, REACHED, {}, tmp_path, ALONE)
    plates = plates_of(capture, masks, body.frames) or []
    plates[1].known[:] = False
    monkeypatch.setattr(gather, "plates_of", lambda *_: plates)
    some = gather_pixels(capture, masks, body, REACHED, {}, tmp_path, ALONE)
    left_out = every.edge & (every.cameras_and_xy(torch.arange(len(every.edge)))[0] == 1)
    assert left_out.any() and torch.equal(some.colour, every.colour[~left_out])
    without_plates = gather_pixels(capture, masks, body, REACHED, {}, tmp_path, ALONE, with_plates=False)
    assert without_plates.plate is None and torch.equal(without_plates.colour, every.colour)


def test_edges_extend_two_pixels_inwards_and_outwards(tmp_path: Path):
    """Around a square of 12 x 12 px, edges are the 16 x 16 px without the inner 8 x 8."""
    capture, masks, body = record(tmp_path)
    square = np.zeros((SIZE_PX, SIZE_PX), bool)
    square[10:22, 10:22] = True
    masks.encoded["0", 0] = encode(square)
    pixels = gather_pixels(capture, masks, body, None, {}, tmp_path, ALONE)
    edge = pixels.edge[: SIZE_PX**2].view(SIZE_PX, SIZE_PX)
    assert edge.sum() == 16**2 - 8**2 and edge[8:24, 8:24].sum() == edge.sum() and not edge[12:20, 12:20].any()


def test_a_body_inside_the_image_reaches_a_disc_around_each_vertex():
    """A reach of 20 cm at 200 m with a focal length of 5000 px is 5 px."""
    xy = np.random.default_rng(0).integers([8, 8], [52, 32], (30, 2))
    visible_pixels = within_reach(AFAR, np.hstack([xy / 25, np.full((30, 1), 200.0)]), 0.2)
    y, x = np.mgrid[:40, :60]
    squared = (x[..., None] - xy[:, 0]) ** 2 + (y[..., None] - xy[:, 1]) ** 2
    assert np.array_equal(visible_pixels, squared.min(-1) <= 25)


def test_a_body_just_outside_the_image_reaches_into_it():
    """A vertex 3 px left of the image in row 20 reaches a disc of radius 5 px: columns 0 to 2 of that row."""
    visible_pixels = within_reach(AFAR, np.array([[-3 / 25, 20 / 25, 200.0]]), 0.2)
    assert np.flatnonzero(visible_pixels[20]).tolist() == [0, 1, 2]
    assert visible_pixels.any(1).nonzero()[0].tolist() == [16, 17, 18, 19, 20, 21, 22, 23, 24]


@pytest.mark.parametrize("xy_px", [(-32, 20), (30, -32), (92, 20), (30, 72)])
def test_a_body_far_outside_the_image_does_not_reach_it(xy_px: tuple[int, int]):
    """Discs of radius 5 px whose centres are 32 or 33 px outside."""
    assert not within_reach(AFAR, np.array([[xy_px[0] / 25, xy_px[1] / 25, 200.0]]), 0.2).any()


def test_an_arm_near_the_camera_reaches_farther_in_pixels():
    """20 cm are 10 px at the arm's 100 m, although most of the body is at 200 m, where they are 5 px."""
    arm, body = np.tile([[20 / 50, 20 / 50, 100.0]], (3, 1)), np.tile([[50 / 25, 20 / 25, 200.0]], (20, 1))
    visible_pixels = within_reach(AFAR, np.vstack([arm, body]), 0.2)
    assert np.flatnonzero(visible_pixels[20]).tolist() == [*range(10, 31), *range(40, 60)]


def test_non_square_pixels_use_the_larger_focal_length():
    """20 cm at 200 m are 5 px across (5000 px focal length) and 2.5 px along (2500 px): all within a disc of 5 px."""
    camera = dataclasses.replace(AFAR, K=np.diag([5000.0, 2500.0, 1.0]))
    visible_pixels = within_reach(camera, np.array([[20 / 25, 20 / 12.5, 200.0]]), 0.2)
    assert np.flatnonzero(visible_pixels[20]).tolist() == [*range(15, 26)]


def test_vertices_off_the_axis_reach_farther_outwards():
    """The vertex at (2, 0, 2) m is 45 degrees off the axis, in column 50. The ray through column p passes it at
    2 |1 - p / 50| / sqrt(1 + (p / 50)^2) m: 18 cm for columns 44 and 57, 21 cm for columns 43 and 58."""
    visible_pixels = within_reach(AHEAD, np.array([[2.0, 0.0, 2.0]]), 0.2)
    assert np.flatnonzero(visible_pixels[0]).tolist() == [*range(44, 58)]
    from_the_right = dataclasses.replace(AHEAD, K=np.array([[50.0, 0, 60], [0, 50, 0], [0, 0, 1]]))
    mirrored = within_reach(from_the_right, np.array([[-2.0, 0.0, 2.0]]), 0.2)  # column p is 60 - p
    assert np.flatnonzero(mirrored[0]).tolist() == [*range(3, 17)]


def test_vertices_behind_the_camera_reach_no_pixels():
    """Of two vertices, the one behind the camera is on the line through pixel (10, 10)."""
    visible_pixels = within_reach(AHEAD, np.array([[0.8, 0.8, 2.0], [-0.2, -0.2, -1]]), 0.2)
    assert visible_pixels[20, 20] and not visible_pixels[10, 10]


def test_a_box_covers_the_convex_hull_of_its_corners():
    """With its margin, the box is 2 to 4 m away. Its near side spans columns 5 to 35 and rows 5 to 25, its far side
    columns 2.5 to 17.5 and rows 2.5 to 12.5; a line through (26.5, 3.75) joins their upper right corners."""
    met = within_box(AHEAD, np.array([[0.4, 0.4, 2.2], [1.2, 0.8, 3.8]]), 0.2)
    y, x = np.array([(3, 3), (5, 35), (25, 5), (25, 35), (15, 20), (4, 27)]).T
    assert met[y, x].all()
    y, x = np.array([(1, 1), (26, 20), (15, 36), (4, 35), (2, 27), (25, 3)]).T
    assert not met[y, x].any()


def test_a_box_around_the_camera_covers_all_pixels():
    vertices_m = np.array([[-1.0, -1, -1], [1, 1, 1]])
    assert within_box(AHEAD, vertices_m, 0.2).all()
    assert np.array_equal(everywhere(AHEAD, vertices_m), np.ones((40, 60), bool))


def test_a_box_that_almost_touches_the_camera_covers_its_pixels() -> None:
    """The box is 10 um to 2 m ahead, 0.2 to 1 m to the right and 0.02 to 1 m down. The ray through (55, 3) is at
    (1.1 z, 0.06 z) and enters it at z = 1/3. The near corners of the box project up to 5 000 000 px away."""
    assert within_box(AHEAD, np.array([[0.4, 0.22, 0.20001], [0.8, 0.8, 1.8]]), 0.2)[3, 55]


def test_a_box_outside_the_image_covers_no_pixels():
    assert not within_box(AHEAD, np.array([[-3.0, 0.0, 2.0], [-1.0, 1.0, 2.5]]), 0.2).any()


@pytest.mark.parametrize("depths_m", [(-1.0, -2.0), (-1.0, -1.0, 2.0), (1e-6, 1e-6)])
def test_a_body_behind_or_at_the_camera(depths_m: tuple[float, ...]):
    """A body behind the camera reaches no pixel, and one around the camera all of them. Of a body on both sides, only
    the part in front counts."""
    vertices_m = np.array([[0.4 * depth, 0.4 * depth, depth] for depth in depths_m])
    visible_pixels = within_reach(AHEAD, vertices_m, 0.2)
    assert visible_pixels.shape == (40, 60)
    assert visible_pixels[20, 20] == (depths_m[-1] > 0)
    assert visible_pixels.all() == (0 < depths_m[-1] < 1)

import numpy as np

from hnerf.body.contour_fit import match, outline
from hnerf.body.descriptor import normals_of
from hnerf.config import FitSettings
from tests.body.recorded_body import ring_camera

SETTINGS = FitSettings(inside_m=0.01, outside_m=0.02, clothing_m=0.1, spacing_m=0.01)


def ball(radius_m: float, height_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a sphere on the axis."""
    rings, around = 24, 48
    polar, turn = np.meshgrid(
        np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, around, endpoint=False), indexing="ij"
    )
    points = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    a, b = i * around + j, i * around + (j + 1) % around
    faces = np.concatenate([np.stack([a, a + around, b], -1), np.stack([b, a + around, b + around], -1)]).reshape(-1, 3)
    return points * radius_m + (0, 0, height_m), faces


def disc(radius_px: float, size_px: int = 256) -> np.ndarray:
    y, x = np.mgrid[:size_px, :size_px]
    return (x - size_px / 2) ** 2 + (y - size_px / 2) ** 2 < radius_px**2


def test_an_outline_runs_between_the_pixels_and_points_outwards() -> None:
    """A mask of columns 10 to 19 and rows 10 to 29 has its edges at 9.5, 19.5, 9.5 and 29.5."""
    mask = np.zeros((40, 40), bool)
    mask[10:30, 10:20] = True
    edge = outline(mask, 1.0)
    left = (edge.points_px[:, 0] < 12) & (np.abs(edge.points_px[:, 1] - 19.5) < 5)
    np.testing.assert_allclose(edge.points_px[left, 0], 9.5, atol=0.05)
    np.testing.assert_allclose(edge.normals[left], np.tile([-1, 0], (left.sum(), 1)), atol=0.05)
    assert 50 <= len(edge.points_px) <= 60  # one a pixel along a perimeter of 60 with rounded corners
    assert edge.distance_px[20, 10] == -0.5 and edge.distance_px[20, 9] == 0.5 and edge.distance_px[20, 5] == 4.5


def test_normals_point_out_of_a_ball() -> None:
    vertices, faces = ball(1.0, 0.0)
    equator = np.abs(vertices[:, 2]) < 0.5
    normals = normals_of(vertices, faces)
    np.testing.assert_allclose(normals[equator], vertices[equator], atol=0.03)


def test_a_body_too_small_is_pulled_outwards_and_one_too_large_is_pushed_in() -> None:
    """A ball of 0.2 m at 3 m, 281.6 px focal length, looks 18.8 px large; the masks are 5 px larger and smaller."""
    camera = ring_camera("a", 0.3)
    vertices, faces = ball(0.2, 1.0)
    normals = normals_of(vertices, faces)
    scale_m = 3 / 281.6
    seen_px = 281.6 * 0.2 / np.sqrt(3**2 - 0.2**2)
    for grow_px, sigma_m in ((5, 0.02), (-5, 0.01)):
        edge = outline(disc(seen_px + grow_px), 1.0)
        rows = match(camera, edge, scale_m, vertices, normals, faces, SETTINGS)
        assert len(rows.vertices) > 20
        np.testing.assert_allclose(np.abs(rows.residual_m).max(), 5 * scale_m, atol=0.6 * scale_m)
        assert (-np.sign(grow_px) * rows.residual_m > 2 * scale_m).all()  # rim vertices lie up to 2.5 px deep
        fades, holds = 1 / (1 + (rows.residual_m / 0.1) ** 2) ** 2, 0.01345 / np.abs(rows.residual_m)
        robust = fades if grow_px > 0 else np.minimum(1, holds)
        np.testing.assert_allclose(rows.weight, robust / sigma_m**2)
        outwards = (vertices[rows.vertices] - (0, 0, 1)) / 0.2
        assert ((rows.gradient * outwards).sum(1) > 0.9).all()  # moving out raises the residual, metre for metre


def test_a_body_that_fills_its_mask_is_left_alone() -> None:
    camera = ring_camera("a", 0.3)
    vertices, faces = ball(0.2, 1.0)
    edge = outline(disc(281.6 * 0.2 / np.sqrt(3**2 - 0.2**2)), 1.0)
    rows = match(camera, edge, 3 / 281.6, vertices, normals_of(vertices, faces), faces, SETTINGS)
    assert np.abs(rows.residual_m).max() < 1.0 * 3 / 281.6


def test_a_part_that_a_mask_lacks_pushes_no_harder_than_one_that_sticks_out_a_little() -> None:
    """Half of the mask is missing. Beyond 1.345 standard deviations of 0.01 m every vertex outside pushes with 1.345 /
    0.01 m."""
    camera = ring_camera("a", 0.3)
    vertices, faces = ball(0.2, 1.0)
    seen = disc(281.6 * 0.2 / np.sqrt(3**2 - 0.2**2))
    seen[:, 128:] = False
    rows = match(camera, outline(seen, 1.0), 3 / 281.6, vertices, normals_of(vertices, faces), faces, SETTINGS)
    out = rows.residual_m > 0.01345
    assert rows.residual_m[out].min() < 0.04 and rows.residual_m[out].max() > 0.18
    np.testing.assert_allclose((rows.weight * rows.residual_m)[out], 134.5)

import numpy as np
import pytest
import trimesh

from hnerf.asset.plate import GAP_WEIGHT_M, LEAST_COTANGENT, SKIN_WEIGHT, ThinPlate, cotangent_laplacian, facing_pairs
from tests.asset.figure import twice

ONE_SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])


def strip(length: int, width: int, step_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a flat grid of squares, each split into two triangles."""
    x, y = np.meshgrid(np.arange(length + 1), np.arange(width + 1), indexing="ij")
    corner = (x[:-1, :-1] * (width + 1) + y[:-1, :-1]).ravel()
    right, up = corner + width + 1, corner + 1
    faces = np.concatenate([np.stack([corner, right, right + 1], 1), np.stack([corner, right + 1, up], 1)])
    return step_m * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1), faces


def test_laplacian_of_a_square_cut_in_two() -> None:
    area_m2, laplacian = cotangent_laplacian(*ONE_SQUARE)
    np.testing.assert_allclose(area_m2, [1 / 3, 1 / 6, 1 / 3, 1 / 6])
    # An edge has half the cotangent of 45 degrees; the diagonal has cotangents of 90 degrees, which are 0.
    expected = [[1, -0.5, 0, -0.5], [-0.5, 1, -0.5, 0], [0, -0.5, 1, -0.5], [-0.5, 0, -0.5, 1]]
    np.testing.assert_allclose(laplacian.toarray(), expected, atol=1e-12)


def test_weights_of_edges_between_obtuse_triangles_stay_positive() -> None:
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0.1, 0], [0.5, -0.1, 0]])
    _, obtuse = cotangent_laplacian(flat, np.array([[0, 1, 2], [0, 3, 1]]))
    assert obtuse[0, 1] == -LEAST_COTANGENT  # both cotangents, of 157 degrees, are -2.4


def test_waves_shorter_than_the_smoothing_length_are_damped() -> None:
    """With a smoothing length l, a wave of length L keeps 1 / (1 + e + (2 pi l / L)^4) of its height; e is
    SKIN_WEIGHT."""
    vertices_m, faces = strip(120, 6, 0.005)
    plate = ThinPlate.of(vertices_m, faces)
    for length_m, smoothing_m in ((0.1, 0.01), (0.1, 0.02), (0.2, 0.02)):
        wave = np.sin(2 * np.pi * vertices_m[:, :1] / length_m)
        smooth = plate.solver(np.ones(len(wave)), smoothing_m)(wave)
        middle = np.abs(vertices_m[:, 0] - 0.3) < 0.1
        kept = (smooth * wave)[middle].sum() / (wave**2)[middle].sum()
        assert kept == pytest.approx(1 / (1 + SKIN_WEIGHT + (2 * np.pi * smoothing_m / length_m) ** 4), rel=0.02)


def test_untrusted_regions_are_filled_in_smoothly() -> None:
    vertices_m, faces = strip(60, 4, 0.01)
    trust = (np.abs(vertices_m[:, 0] - 0.3) > 0.05).astype(float)
    moved_m = ThinPlate.of(vertices_m, faces).solver(trust, 0.01)(np.where(trust, 0.02, 5.0)[:, None])
    np.testing.assert_allclose(moved_m, 0.02, rtol=1e-3)


def two_boxes(gap_m: float) -> trimesh.Trimesh:
    return twice(trimesh.creation.box(extents=(0.02, 0.02, 0.02)).subdivide(), (0.02 + gap_m, 0, 0))


def test_pairs_across_a_gap() -> None:
    boxes = two_boxes(0.004)
    differences, width_m = facing_pairs(boxes.vertices, boxes.faces)
    assert len(width_m) >= 2  # at least the middles of the two facing sides
    across = differences @ boxes.vertices
    np.testing.assert_allclose(np.linalg.norm(across, axis=1), width_m, rtol=1e-3)
    normal = np.abs(across[:, 0]) / width_m
    assert width_m[normal > 0.99] == pytest.approx(0.004, rel=0.05)
    apart = two_boxes(0.04)
    assert len(facing_pairs(apart.vertices, apart.faces)[1]) == 0


def test_the_two_sides_of_a_narrow_gap_move_together() -> None:
    """Box 1 is pulled by d, box 2 is held in place. The gap is much narrower than GAP_WEIGHT_M, so they share the
    displacement."""
    boxes = two_boxes(GAP_WEIGHT_M / 10)
    plate = ThinPlate.of(boxes.vertices, boxes.faces)
    first = boxes.vertices[:, 0] < 0.0101
    wanted = np.where(first, 0.01, 0.0)[:, None]
    moved = plate.solver(np.ones(len(wanted)), 0.1)(wanted)  # so each box is stiff
    assert moved[first].mean() - moved[~first].mean() < 0.004  # without coupling it would be 0.01
    assert moved.mean() == pytest.approx(0.005, rel=0.01)

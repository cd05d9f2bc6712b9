import numpy as np
import pytest
import trimesh

from hnerf.evaluation.geometry import outer_samples, score_geometry, volume_overlap
from hnerf.geometry.mesh_queries import Surface


def plane(height_m: float = 0.0, tilt_deg: float = 0.0) -> trimesh.Trimesh:
    """Return a square with sides of 1 m at a height, tilted about the x axis."""
    corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    turned = corners @ trimesh.transformations.rotation_matrix(np.deg2rad(tilt_deg), [1, 0, 0])[:3, :3].T
    return trimesh.Trimesh(turned + np.array([0, 0, height_m]), [[0, 1, 2], [0, 2, 3]], process=False)


def cube(x_m: float = 0.0, side_m: float = 1.0) -> trimesh.Trimesh:
    return trimesh.creation.box([side_m] * 3).apply_translation([x_m, 0, 0])


def test_scores_of_parallel_planes_by_hand() -> None:
    score = score_geometry(plane(), plane(0.1), np.random.default_rng(0), samples=2000, nodes=16)
    assert score["chamfer_mm"] == pytest.approx(100.0, rel=1e-5)
    assert score["chamfer_l2_e3"] == pytest.approx(10.0, rel=1e-5)  # 0.1^2 x 1e3
    assert score["normal_consistency"] == pytest.approx(1.0)
    assert not score["watertight"]


def test_normal_consistency_of_tilted_planes() -> None:
    score = score_geometry(plane(), plane(tilt_deg=60), np.random.default_rng(0), samples=2000, nodes=16)
    assert score["normal_consistency"] == pytest.approx(0.5, abs=1e-6)  # cos 60 degrees everywhere


def test_normal_consistency_ignores_which_way_faces_point() -> None:
    turned = trimesh.Trimesh(plane(0.1).vertices, plane().faces[:, ::-1], process=False)
    score = score_geometry(plane(), turned, np.random.default_rng(0), samples=2000, nodes=16)
    assert score["normal_consistency"] == pytest.approx(1.0)


def test_distances_are_to_the_surface_not_to_samples() -> None:
    score = score_geometry(cube(), cube(), np.random.default_rng(0), samples=500, nodes=16)
    assert score["chamfer_mm"] < 1e-3
    assert score["iou"] == 1.0
    assert score["watertight"]


def test_chamfer_averages_both_directions() -> None:
    """From a plane, the nearer of two others is 10 cm away everywhere. Of the two others, half is 10 cm away and half
    30 cm: 20 cm on average, and 0.05 m^2 squared."""
    both = trimesh.util.concatenate(plane(0.1), plane(0.3))
    for pair in ((plane(), both), (both, plane())):
        score = score_geometry(*pair, np.random.default_rng(0), samples=4000, nodes=16)
        assert score["chamfer_mm"] == pytest.approx((100 + 200) / 2, rel=0.03)
        assert score["chamfer_l2_e3"] == pytest.approx((10 + 50) / 2, rel=0.05)


def test_normal_consistency_averages_both_directions() -> None:
    """All of a plane is nearest to a parallel one. Of that one and a plane tilted by 60 degrees far above, half is
    parallel to it."""
    both = trimesh.util.concatenate(plane(0.1), plane(1.0, tilt_deg=60))
    for pair in ((plane(), both), (both, plane())):
        score = score_geometry(*pair, np.random.default_rng(0), samples=4000, nodes=16)
        assert score["normal_consistency"] == pytest.approx((1 + (1 + 0.5) / 2) / 2, abs=0.01)


@pytest.mark.parametrize("x_m", [-0.5, 0.5])
def test_iou_covers_the_bounds_of_both_volumes(x_m: float) -> None:
    score = score_geometry(cube(x_m), cube(), np.random.default_rng(0), samples=500, nodes=64)
    assert score["iou"] == pytest.approx(0.5 / 1.5, abs=0.02)


def test_watertight_refers_to_the_prediction() -> None:
    for predicted, truth, closed in ((cube(), plane(), True), (plane(), cube(), False)):
        score = score_geometry(predicted, truth, np.random.default_rng(0), samples=100, nodes=8)
        assert score["watertight"] is closed


def test_closest_points_of_distant_points_are_exact() -> None:
    distance_m, face = Surface(cube()).closest(np.array([[20.0, 0, 0], [0, 0, -2000.0]]))
    assert distance_m == pytest.approx([19.5, 1999.5])
    np.testing.assert_allclose(cube().face_normals[face], [[1, 0, 0], [0, 0, -1]], atol=1e-12)


def test_volume_overlap_of_offset_cubes() -> None:
    surfaces = Surface(cube()), Surface(cube(0.5))
    # Nodes are centres of cells of 1/64 m that no side of a cube cuts, so counted volumes are exact.
    lower_m, upper_m = np.array([-0.5, -0.5, -0.5]) + 1 / 128, np.array([1.5, 1.5, 1.5]) - 1 / 128
    assert volume_overlap(*surfaces, lower_m, upper_m, 128) == pytest.approx(0.5 / 1.5)


def test_hidden_layers_are_not_sampled() -> None:
    both = trimesh.util.concatenate(cube(), cube(side_m=0.8))
    points_m, normals = outer_samples(Surface(both), 3000, np.random.default_rng(0))
    assert np.abs(points_m).max(1) == pytest.approx(0.5)  # all on the outer cube
    assert len(points_m) == pytest.approx(3000 / 1.64, rel=0.05)  # the outer cube's fraction of 6 + 6 x 0.64 m^2
    assert np.abs(normals).max(1) == pytest.approx(1.0)


def test_occupancy_matches_the_winding_number_at_every_node() -> None:
    mesh = trimesh.util.concatenate(trimesh.creation.icosphere(2, 0.3), trimesh.creation.torus(0.5, 0.06))
    surface, lower_m, upper_m = Surface(mesh), mesh.bounds[0] - 0.02, mesh.bounds[1] + 0.02
    axes = [np.linspace(a, b, 40) for a, b in zip(lower_m, upper_m, strict=True)]
    nodes_m = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    assert np.array_equal(surface.occupancy(lower_m, upper_m, 40).ravel(), surface.inside(nodes_m))

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from hnerf.body import contour_fit
from hnerf.body.articulation import Articulation
from hnerf.body.contour_fit import (
    ContourResiduals,
    Outline,
    _contain,
    _cover,
    _ground_contact,
    _rim,
    _sole_m,
    add_residuals,
    lacked_keypoints,
    match,
    outline,
)
from hnerf.body.descriptor import normals_of
from hnerf.body.normal_equations import NormalEquations
from hnerf.config import FitSettings
from hnerf.geometry.camera import Camera
from tests.body.recorded_body import ring_camera
from tests.body.test_articulation import random_pose
from tests.body.two_bone import two_bone_rig

SETTINGS = FitSettings(inside_m=0.01, outside_m=0.02, clothing_m=0.1, spacing_m=0.01)
NONE_PX = np.zeros((0, 2))
SCALE_M = 3 / 281.6  # metres per pixel at 3 m with the focal length of `ring_camera`
SEEN_PX = 281.6 * 0.2 / np.sqrt(3**2 - 0.2**2)  # radius of a ball of 0.2 m in the image


def ball(radius_m: float, height_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a sphere centred on the z axis."""
    rings, around = 24, 48
    polar, turn = np.meshgrid(
        np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, around, endpoint=False), indexing="ij"
    )
    points = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    a, b = i * around + j, i * around + (j + 1) % around
    faces = np.concatenate([np.stack([a, a + around, b], -1), np.stack([b, a + around, b + around], -1)]).reshape(-1, 3)
    return points * radius_m + (0, 0, height_m), faces


def disc(radius_px: float) -> np.ndarray:
    y, x = np.mgrid[:256, :256] - 128
    return x**2 + y**2 < radius_px**2


def naked(camera: Camera, edge: Outline, *body: Any, lacked_px: np.ndarray = NONE_PX) -> ContourResiduals:
    return match(camera, edge, lacked_px, *body, SETTINGS)


def matched(
    edge: Outline, match: Callable[..., ContourResiduals] = naked, **more: Any
) -> tuple[ContourResiduals, np.ndarray]:
    """Return the match of a ball of 0.2 m in front of a camera with an outline, and the outward directions of the
    matched vertices."""
    vertices, faces = ball(0.2, 1.0)
    rows = match(ring_camera("a", 0.3), edge, SCALE_M, vertices, normals_of(vertices, faces), faces, **more)
    return rows, (vertices[rows.vertices] - (0, 0, 1)) / 0.2


def test_an_outline_runs_between_the_pixels_and_points_outwards() -> None:
    """A mask of columns 10 to 19 and rows 10 to 29 has edges at columns 9.5 and 19.5 and rows 9.5 and 29.5."""
    mask = np.zeros((40, 40), bool)
    mask[10:30, 10:20] = True
    edge = outline(mask, 1.0)
    left = (edge.points_px[:, 0] < 12) & (np.abs(edge.points_px[:, 1] - 19.5) < 5)
    np.testing.assert_allclose(edge.points_px[left, 0], 9.5, atol=0.05)
    np.testing.assert_allclose(edge.normals[left], np.tile([-1, 0], (left.sum(), 1)), atol=0.05)
    assert 50 <= len(edge.points_px) <= 60  # one point per pixel along a perimeter of 60 px with rounded corners
    assert edge.distance_px[20, 10] == -0.5 and edge.distance_px[20, 9] == 0.5 and edge.distance_px[20, 5] == 4.5


def test_sparse_distance_maps_interpolate_the_full_ones() -> None:
    """Distances to the right of a disc of 20 px around (128, 128) are stored at every third pixel, in an image whose
    last column is not one of them."""
    full, sparse = (outline(disc(20), 1.0, stride) for stride in (1, 3))
    assert (full.distance_px.shape, sparse.distance_px.shape) == ((256, 256), (86, 86))
    along_px = np.stack([np.linspace(140, 254, 50), np.full(50, 128.0)], 1)
    np.testing.assert_allclose(full.distance_at(along_px), along_px[:, 0] - 148, atol=0.6)
    np.testing.assert_allclose(sparse.distance_at(along_px), full.distance_at(along_px), atol=0.1)
    assert sparse.distance_at(np.array([[300.0, 128]])) == sparse.distance_at(np.array([[255.0, 128]]))
    for edge in (full, sparse):
        [_], [direction], [distance_px] = _contain(edge, np.array([[200.0, 128]]), 2.0, NONE_PX, 0.0)
        np.testing.assert_allclose([*direction, distance_px], [1, 0, 52], atol=0.6)


def test_a_body_too_small_is_pulled_outwards_and_one_too_large_is_pushed_in() -> None:
    """A ball of 0.2 m at 3 m with a focal length of 281.6 px has a radius of 18.8 px. The masks are 5 px larger and
    smaller."""
    for grow_px, sigma_m in ((5, 0.02), (-5, 0.01)):
        rows, outwards = matched(outline(disc(SEEN_PX + grow_px), 1.0))
        assert len(rows.vertices) > 20
        np.testing.assert_allclose(np.abs(rows.residual_m).max(), 5 * SCALE_M, atol=0.6 * SCALE_M)
        assert (-np.sign(grow_px) * rows.residual_m > 2 * SCALE_M).all()  # rim vertices lie up to 2.5 px inside
        fades, holds = 1 / (1 + (rows.residual_m / 0.1) ** 2) ** 2, 0.01345 / np.abs(rows.residual_m)
        robust = fades if grow_px > 0 else np.minimum(1, holds)
        np.testing.assert_allclose(rows.weight, robust / sigma_m**2)
        assert ((rows.gradient * outwards).sum(1) > 0.9).all()  # moving outwards raises the residual 1:1


def test_nothing_is_pushed_in_around_a_keypoint_that_the_mask_lacks() -> None:
    """A ball is 5 px larger than its mask. A keypoint 21 px to its right is 0.3 m, 28 px, or less from the ball's right
    side, and more from its left side."""
    camera, vertices_m = ring_camera("a", 0.3), ball(0.2, 1.0)[0]
    for lacked_px, rightmost_px in ((NONE_PX, 18), (np.array([[128 + SEEN_PX + 21, 128]]), 14.4)):
        rows, _ = matched(outline(disc(SEEN_PX - 5), 1.0), lacked_px=lacked_px)
        aside_px = camera.project(vertices_m[rows.vertices])[0][:, 0] - 128
        np.testing.assert_allclose([aside_px.min(), aside_px.max()], [-18, rightmost_px], atol=1)


def test_keypoints_that_a_third_of_the_masks_lack_are_lacked_there() -> None:
    """A pixel spans 1 mm. Keypoint 4 is 30 mm outside two of four masks, in a frame without a mask, and without
    confidence in another; 5 is 30 mm outside one of four, and seen in no other; 6 is 15 mm outside all of them."""
    edge, keypoints = outline(disc(20), 1.0), np.zeros((5, 25, 3))
    keypoints[:, 4:7] = 128, 128, 0.6
    keypoints[[0, 1, 2, 4], 4, 0] = keypoints[3, 5, 0] = 178
    keypoints[:, 6, 0] = 163
    keypoints[4, 4, 2] = 0.4
    keypoints[[0, 1, 2, 4], 5, 2] = 0
    found = lacked_keypoints(keypoints, np.full(5, 1e-3), [edge, None, edge, edge, edge])
    assert [points.tolist() for points in found] == [[[178, 128]], [], [[178, 128]], [], []]


def test_a_body_that_fills_its_mask_is_not_moved() -> None:
    assert np.abs(matched(outline(disc(SEEN_PX), 1.0))[0].residual_m).max() < SCALE_M


def test_the_push_of_vertices_outside_the_mask_is_bounded() -> None:
    """Half of the mask is missing. Every vertex that is outside by more than 1.345 standard deviations of 0.01 m pushes
    with 1.345 / 0.01 m."""
    seen = disc(SEEN_PX)
    seen[:, 128:] = False
    rows, _ = matched(outline(seen, 1.0))
    out = rows.residual_m > 0.01345
    assert rows.residual_m[out].min() < 0.04 and rows.residual_m[out].max() > 0.18
    np.testing.assert_allclose((rows.weight * rows.residual_m)[out], 134.5)


def test_a_hand_in_front_of_the_trunk_has_no_outline() -> None:
    """A small ball is half a metre in front of a large one, as seen by the camera. Its rim lies inside the large ball's
    silhouette."""
    camera, (trunk_m, faces), (hand_m, _) = ring_camera("a", 0.3), ball(0.2, 1.0), ball(0.05, 1.0)
    hand_m = hand_m + 0.5 * np.array([np.cos(0.3), np.sin(0.3), 0])
    both_m, both = np.concatenate([trunk_m, hand_m]), np.concatenate([faces, faces + len(trunk_m)])
    rim = _rim(camera, both_m, normals_of(both_m, both), both)
    assert len(rim) > 20 and rim.max() < len(trunk_m)
    assert len(_rim(camera, hand_m, normals_of(hand_m, faces), faces)) > 20


def test_the_rim_continues_beyond_the_image_border() -> None:
    """An image of half the width shows only the left half of a ball in the middle."""
    camera, (vertices, faces) = ring_camera("a", 0.3), ball(0.2, 1.0)
    half, normals = dataclasses.replace(camera, width_px=128), normals_of(vertices, faces)
    rim, seen = (_rim(c, vertices, normals, faces) for c in (camera, half))
    column = camera.project(vertices)[0][:, 0]
    for side in (column[rim] < 124, column[rim] > 132):
        assert side.sum() > 10 and np.isin(rim[side], seen).all()


def test_vertices_of_no_face_are_not_on_the_rim() -> None:
    """One is as near to the outline as the vertices of the ball are."""
    vertices, faces = ball(0.2, 1.0)
    camera = ring_camera("a", 0.3)
    expected = _rim(camera, vertices, normals_of(vertices, faces), faces)
    sideways = np.cross(camera.centre_m, (0, 0, 1))
    beside_m = 0.195 * sideways / np.linalg.norm(sideways) + (0, 0, 1)
    with_one = np.concatenate([vertices, beside_m[None]])
    np.testing.assert_array_equal(_rim(camera, with_one, normals_of(with_one, faces), faces), expected)


def test_an_outline_pulls_rim_vertices_inside_it_with_matching_normals() -> None:
    """The outside of an edge is up. One rim vertex is 3 px inside, one 3 px outside, and one 3 px inside but facing
    right."""
    edge = Outline(np.array([[10.0, 0], [20, 0], [30, 0]]), np.tile([0.0, -1], (3, 1)), (1, 1), np.zeros((1, 1)))
    rim_px = np.array([[10.0, 3], [20, -3], [30, 3]])
    ids, direction, signed_px = _cover(edge, rim_px, np.array([[0.0, -1], [0, -1], [1, 0]]))
    assert (ids.tolist(), direction.tolist(), signed_px.tolist()) == ([0], [[0, -1]], [-3])


def test_one_vertex_per_cell_is_pushed_back_to_the_mask() -> None:
    """A disc of 20 px lies in an image of 256 x 200 px. To its right are two rim vertices in one cell of 2 px. Below it
    are two in separate cells; the row and column of one of these add up to the same as in the first cell. One vertex is
    inside the disc, one outside the image."""
    edge = outline(disc(20)[:200], 1.0)
    rim_px = np.array([[200.0, 128], [200.4, 128.3], [128, 190], [138, 190], [130, 130], [300, 128]])
    ids, direction, distance_px = _contain(edge, rim_px, 2.0, NONE_PX, 0.0)
    assert sorted(ids.tolist()) == [0, 2, 3]
    right, below = ids.tolist().index(0), ids.tolist().index(2)
    np.testing.assert_allclose(direction[[right, below]], [[1, 0], [0, 1]], atol=0.05)
    np.testing.assert_allclose(distance_px[[right, below]], [52, 42], atol=1)


def test_residuals_add_gradient_and_curvature_to_the_normal_equations() -> None:
    """Residuals added twice count twice. Along any direction through pose and shape, gradient and curvature are those
    of the sum of w (r + g . dx)^2."""
    rig, frame, step = two_bone_rig(), 1, 1e-6
    articulation, pose = Articulation(rig), random_pose(rig, 2)
    random = np.random.default_rng(0)
    rows = ContourResiduals(np.array([1, 3]), random.normal(size=(2, 3)), np.array([0.1, -0.2]), np.array([4.0, 9]))
    equations = NormalEquations(2, articulation.unknowns, 3)
    for _ in range(2):
        add_residuals(equations, articulation, articulation.skin(pose), frame, rows)
    by_pose, by_shape = random.normal(size=articulation.unknowns), 0.7
    ends_m = []
    for sign in (1, -1):
        steps = np.zeros((2, articulation.unknowns))
        steps[frame] = sign * step * by_pose
        moved = articulation.apply_step(pose, torch.from_numpy(steps))
        moved = dataclasses.replace(moved, rig=rig.reshaped(rig.beta + sign * step * by_shape))
        ends_m.append(Articulation(moved.rig).surface(Articulation(moved.rig).skin(moved), frame).numpy())
    along = (rows.gradient * (ends_m[0] - ends_m[1])[rows.vertices] / (2 * step)).sum(1)
    shared = np.array([by_shape, 0, 0])
    slope = equations.frame_gradient[frame] @ by_pose + equations.shared_gradient @ shared
    np.testing.assert_allclose(slope, 2 * (rows.weight * rows.residual_m * along).sum(), rtol=1e-5)
    curvature = by_pose @ equations.frame[0][frame] @ by_pose + shared @ equations.shared @ shared
    curvature += 2 * by_pose @ equations.border[frame] @ shared
    np.testing.assert_allclose(curvature, 2 * (rows.weight * along**2).sum(), rtol=1e-5)
    assert not equations.frame_gradient[0].any() and not equations.border[0].any()


def test_sole_thickness_is_how_far_the_mask_reaches_below_the_foot() -> None:
    """A camera at a height of 1 m looks horizontally at the axis, 3 m away. A foot 0.3 m lower is 28.16 px below the
    image's middle, at row 156.16. A mask that ends at row 159.5 reaches 3.34 px farther down, of 3 / 281.6 m each. A
    toe more than 15 mm above the ground is ignored. A mask that ends above the foot gives a sole of 0; a sole is at
    most 5 cm thick."""
    camera, scale_m = ring_camera("a", 0.3), 3 / 281.6
    foot = np.array([[0, 0, 0.7], [0, 0, 0.8], [1.0, 0.3, 0.716]])

    def sole_to(rows: int) -> float | None:
        mask = np.zeros((256, 256), bool)
        mask[20:rows, 20:236] = True
        return _sole_m(camera, outline(mask, 1.0), scale_m, foot, 2)

    np.testing.assert_allclose(sole_to(160), 3.34 * scale_m, atol=1e-6)
    np.testing.assert_allclose([sole_to(150), sole_to(200)], [0, 0.05], rtol=1e-6)


def test_a_sole_is_measured_below_the_vertex_lowest_in_the_image() -> None:
    """Of two vertices on the ground, 3 m and 2.8 m away, the nearer one is lower in the image: row 127.5 + 281.6 / 2.8
    = 228.07, in either order. The mask ends at row 234.5."""
    camera, mask = ring_camera("a", 0.0), np.zeros((256, 256), bool)
    mask[20:235, 20:236] = True
    foot = np.array([[0, 0, 0.0], [0.2, 0, 0.005]])
    for order in (foot, foot[::-1]):
        rows = camera.project(order)[0][:, 1]
        np.testing.assert_allclose(
            _sole_m(camera, outline(mask, 1.0), 0.005, order, 2), (234.5 - rows.max()) * 0.005, rtol=1e-3
        )
        assert abs(rows.max() - rows.min()) > 5


def test_a_foot_near_the_image_border_has_no_sole() -> None:
    """As above, the foot is at row 156.16: 0.84, 1.84 and 2.84 px above the last row of three images."""
    foot, mask = np.array([[0, 0, 0.7]]), np.ones((256, 256), bool)
    for height_px, seen in ((158, False), (159, False), (160, True)):
        camera = dataclasses.replace(ring_camera("a", 0.3), height_px=height_px)
        found = _sole_m(camera, outline(mask[:height_px], 1.0), 3 / 281.6, foot, 2)
        assert (found is not None) is seen


def test_a_sole_stands_on_the_ground() -> None:
    """A foot 5 cm above the ground with a sole of 2 cm should fall by 3 cm, with a weight of 1 / 0.01^2 over (1 +
    0.2^2)^2."""
    rows = _ground_contact(np.array([[0, 0, 0.3], [0, 0.1, 0.05]]), 2, 0.02)
    assert rows.vertices.tolist() == [1] and rows.gradient.tolist() == [[0, 0, 1]]
    np.testing.assert_allclose([rows.residual_m[0], rows.weight[0]], [0.03, 1e4 / 1.04**2])


def test_steps_that_diverge_are_undone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The third pose fits best, and the fifth more than 1.5 times worse."""
    rms_mm = iter([20.0, 10.0, 9.0, 11.0, 30.0, 40.0])
    monkeypatch.setattr(contour_fit, "_outline_step", lambda problem, pose, *_: (pose + 1, 0.0, next(rms_mm)))
    problem: Any = SimpleNamespace(settings=FitSettings(contour_steps=6), observations=SimpleNamespace(cameras=()))
    first: Any = 0
    assert contour_fit.refine_with_outlines(problem, first, [], None, 1) == 2

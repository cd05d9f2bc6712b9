import numpy as np
import pytest
import torch

from hnerf.asset.correctives import Correctives, correctives_of, frame_surfaces
from hnerf.asset.figures import beyond_skinning_mm
from hnerf.avatar.surface import step_to_surface
from tests.asset.figure import bending_body, dressed, posed_with_displacements, upright_column
from tests.asset.stand_in import StandInAvatar


def test_steps_to_the_surface_fade_to_zero_beyond_half_the_longest() -> None:
    steps_m = step_to_surface(torch.tensor([0.01, -0.015, 0.0225, 0.03, 0.2]))
    torch.testing.assert_close(steps_m, torch.tensor([0.01, -0.015, 0.01125, 0.0, 0.0]))


def test_the_skinned_surface_is_moved_onto_the_fields_surface() -> None:
    """Clothes of radius 17 cm around a field of radius 16 cm: in every pose the sides move 1 cm inwards in rest
    coordinates, away from the joint."""
    body, clothes = bending_body(), upright_column(0.17, -0.02, 1.62)
    clothed = dressed(body, clothes)
    surfaces_m, moved_m = frame_surfaces(StandInAvatar(body), clothed)
    rest_m = clothes.vertices
    sides = (np.abs(rest_m[:, 2] - 0.8) > 0.35) & (rest_m[:, 2] > 0.1) & (rest_m[:, 2] < 1.5)
    inwards = -0.01 * rest_m[sides] / np.linalg.norm(rest_m[sides, :2], axis=1, keepdims=True) * (1, 1, 0)
    assert moved_m.shape == (len(body.frames), len(rest_m), 3)
    for frame in moved_m:
        np.testing.assert_allclose(frame[sides], inwards, atol=0.0015)
    np.testing.assert_allclose(posed_with_displacements(clothed, moved_m), surfaces_m, atol=1e-6)


def test_surfaces_follow_displacements_along_the_surface() -> None:
    """In the last frame, which is bent, the field's column slides 1 cm upwards along its own surface."""

    class Sliding(StandInAvatar):
        def frame_displacements(self, points_m: torch.Tensor, theta: torch.Tensor, root: torch.Tensor) -> torch.Tensor:
            moved_m = super().frame_displacements(points_m, theta, root)
            moved_m[-1, :, 2] = 0.01
            return moved_m

    body, clothes = bending_body(), upright_column(0.16, -0.02, 1.62)
    clothed = dressed(body, clothes)
    surfaces_m, moved_m = frame_surfaces(Sliding(body), clothed)
    height_m = clothes.vertices[:, 2]
    sides = (np.abs(height_m - 0.8) > 0.35) & (height_m > 0.1) & (height_m < 1.5)
    np.testing.assert_allclose(moved_m[-1, sides], np.broadcast_to([0, 0, 0.01], (sides.sum(), 3)), atol=0.0015)
    np.testing.assert_allclose(moved_m[0, sides], 0, atol=0.0015)
    np.testing.assert_allclose(posed_with_displacements(clothed, moved_m), surfaces_m, atol=1e-6)


def rebuilt(found: Correctives) -> np.ndarray:
    """Return the displacements (n, V, 3) that blend shapes and weights reproduce."""
    return np.einsum("nk,kvd->nvd", found.weights, found.offsets_m)


def test_displacements_of_both_signs_become_two_opposite_shapes() -> None:
    """The displacements are 1, -2 and 0 times one shape. The largest, -2, becomes a blend shape with weight 1. The
    other sign, 1, becomes the opposite shape, scaled so that its greatest weight is 1 too."""
    shape_m = np.array([[0.01, 0, 0], [0, -0.02, 0]])
    found = correctives_of(np.stack([shape_m, -2 * shape_m, 0 * shape_m]).astype(np.float32), 1)
    np.testing.assert_allclose(found.weights, [[0, 1], [1, 0], [0, 0]], atol=1e-6)
    np.testing.assert_allclose(found.offsets_m, [-2 * shape_m, shape_m], atol=1e-7)


def test_distance_beyond_skinning_by_hand() -> None:
    """Two frames of one vertex, 3 and 4 cm off the skinned surface: 3.54 cm root mean square. A shape of 4 cm with the
    weights 0.5 and 1 leaves 1 and 0 cm: 0.71 cm."""
    shapes = Correctives(np.array([[[0, 0.04, 0]]], np.float32), np.array([[0.5], [1]], np.float32))
    found = beyond_skinning_mm(np.array([[[0, 0.03, 0]], [[0, 0.04, 0]]], np.float32), shapes)
    assert found == pytest.approx({"skinned": 10 * 12.5**0.5, "with_correctives": 10 * 0.5**0.5})


def test_weights_are_from_0_to_1_and_rebuild_all_components() -> None:
    moved_m = np.random.default_rng(0).normal(size=(5, 7, 3)).astype(np.float32)
    found = correctives_of(moved_m, 5)
    assert found.weights.shape == (5, 6)
    assert (found.weights.min(), found.weights.max()) == (0, 1)
    np.testing.assert_allclose(rebuilt(found), moved_m, atol=1e-5)


def test_shapes_minimise_the_squared_residual_displacement() -> None:
    """Of two orthogonal components, of 3 and 1 cm, the larger is kept."""
    moved_m = np.array([[[0.03, 0, 0]], [[0, 0.01, 0]]], np.float32)
    np.testing.assert_allclose(rebuilt(correctives_of(moved_m, 1))[:, 0], [[0.03, 0, 0], [0, 0, 0]], atol=1e-7)
    assert correctives_of(moved_m, 8).weights.shape == (2, 3)
    assert correctives_of(moved_m, 0).offsets_m.shape == (0, 1, 3)

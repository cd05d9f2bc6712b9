"""Estimate the light from points that turn in a known light."""

import numpy as np
import pytest

from hnerf.asset.light import LEAST_IRRADIANCE, Light, Shading, fit_light

UP = np.array([0.0, 0, 1])
COEFFICIENTS = np.array([1.0, 0.2, 0.5, -0.1, 0.1, 0.2, 0.3, -0.2, 0.1])


def directions(count: int, seed: int = 0) -> np.ndarray:
    """Return random unit vectors (count, 3) in all directions."""
    found = np.random.default_rng(seed).normal(size=(count, 3))
    unit: np.ndarray = found / np.linalg.norm(found, axis=1, keepdims=True)
    return unit


def shaded(normals: np.ndarray, point: np.ndarray, light: Light) -> Shading:
    """Return the noise-free shading of points with albedos from 0.1 to 0.8 at given normals."""
    albedo = np.random.default_rng(1).uniform(0.1, 0.8, (point.max() + 1, 3))
    colours = albedo[point] * light.irradiance(normals)[:, None]
    return Shading(point, normals, colours, np.ones(len(point)))


def test_irradiance_by_hand() -> None:
    """For the radiance 1 + 0.3 sqrt(3) z: E = 1 + 2/3 x 0.3 sqrt(3) z = 1 + 0.34641 z. The radiance (3 z^2 - 1) sqrt(5)
    / 2 is sqrt(5) at the poles; E keeps a quarter of it."""
    first = Light(np.array([1, 0, 0.3, 0, 0, 0, 0, 0, 0]), 0.0)
    normals = np.stack([UP, -UP, [1.0, 0, 0]])
    np.testing.assert_allclose(first.irradiance(normals), [1.34641, 0.65359, 1], atol=1e-5)
    second = Light(np.array([1, 0, 0, 0, 0, 0, 1.0, 0, 0]), 0.0)
    np.testing.assert_allclose(second.irradiance(normals), [1.559017, 1.559017, 1 - 5**0.5 / 8], atol=1e-6)


def test_irradiance_has_a_positive_minimum() -> None:
    dark = Light(np.array([0.1, 0, 1.0, 0, 0, 0, 0, 0, 0]), 0.0)
    assert dark.irradiance(-UP[None])[0] == LEAST_IRRADIANCE


def test_light_is_recovered_from_turning_points() -> None:
    point = np.repeat(np.arange(50), 20)
    found = fit_light(shaded(directions(1000), point, Light(COEFFICIENTS, 0.0)))
    np.testing.assert_allclose(found.coefficients / found.coefficients[0], COEFFICIENTS, atol=2e-3)
    assert found.irradiance(directions(1000)).max() == pytest.approx(1)
    assert found.turn_deg == pytest.approx(np.degrees(1), rel=0.05)  # random normals average to about 0


def test_outlier_colours_of_another_surface_have_little_influence() -> None:
    """Of the colours whose normals point up, every third shows something dark instead."""
    point = np.repeat(np.arange(50), 20)
    shading = shaded(directions(1000), point, Light(COEFFICIENTS, 0.0))
    shading.colours[np.flatnonzero(shading.normals[:, 2] > 0)[::3]] = 0.01
    found = fit_light(shading)
    np.testing.assert_allclose(found.coefficients / found.coefficients[0], COEFFICIENTS, atol=0.05)


def test_points_that_do_not_turn_leave_the_light_constant() -> None:
    """On a sphere at rest, the shading could just as well be part of the albedo."""
    normals = directions(50)[np.repeat(np.arange(50), 4)]
    found = fit_light(shaded(normals, np.repeat(np.arange(50), 4), Light(COEFFICIENTS, 0.0)))
    np.testing.assert_allclose(found.coefficients, np.eye(9)[0], atol=1e-9)
    assert found.turn_deg == pytest.approx(0, abs=1e-9)


def test_turning_about_one_axis_reveals_no_light_along_it() -> None:
    """Normals perpendicular to Z that turn about Z observe only cos and sin of the angle and of twice the angle."""
    angle = np.random.default_rng(2).uniform(0, 2 * np.pi, 1000)
    normals = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    found = fit_light(shaded(normals, np.repeat(np.arange(50), 20), Light(COEFFICIENTS, 0.0))).coefficients
    assert np.abs(found[[2, 5, 7]]).max() < 1e-9 * found[0]  # z, yz, xz
    assert np.abs(found[[1, 3, 4, 8]]).min() > 0.05 * found[0]


def test_a_rotated_light_has_the_same_irradiance_at_rotated_normals() -> None:
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # takes x to y
    light = Light(COEFFICIENTS, 3.0)
    normals = directions(20)
    turned = light.turned(quarter)
    np.testing.assert_allclose(turned.irradiance(normals @ quarter.T), light.irradiance(normals), atol=1e-9)
    assert turned.turn_deg == 3.0


def test_without_observations_the_light_is_uniform() -> None:
    nothing = Shading(np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    found = fit_light(nothing)
    np.testing.assert_allclose(found.irradiance(directions(5)), 1)
    assert found.turn_deg == 0

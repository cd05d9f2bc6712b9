"""The dome light: where it is bright, and that it illuminates as the fitted light does."""

import numpy as np

from hnerf.asset.dome import HEIGHT_PX, dome, dome_directions
from hnerf.asset.light import Light
from hnerf.asset.srgb import to_linear
from tests.asset.test_light import COEFFICIENTS, directions

SHARPER = np.array([0.4, 0.1, 0.32, 0.12, 0.1, 0.2, 0.25, 0.27, 0.03])  # its radiance is negative in places


def test_directions_of_a_latlong_image() -> None:
    """In an image of 2 x 4 pixels, the second column looks 45 degrees left of +Z, towards +X, and the upper row 45
    degrees up. All eight pixels cover the same solid angle, an eighth each."""
    found, share = dome_directions(2)
    assert found.shape == (8, 3)
    np.testing.assert_allclose(found[1], [0.5, 0.5**0.5, 0.5], atol=1e-12)
    np.testing.assert_allclose(found[4 + 3], [-0.5, -(0.5**0.5), -0.5], atol=1e-12)
    np.testing.assert_allclose(share, 1 / 8)


def test_a_dome_has_the_irradiance_of_its_light() -> None:
    for coefficients in (COEFFICIENTS, SHARPER, np.eye(9)[0]):
        light = Light(coefficients, 0.0)
        picture, intensity = dome(light)
        radiance = intensity * to_linear(picture[..., 0].ravel() / 255)
        sky, share = dome_directions(HEIGHT_PX)
        normals = directions(50, 5)
        lit = 4 * (normals @ sky.T).clip(0) @ (share * radiance)
        np.testing.assert_allclose(lit, light.irradiance(normals), atol=0.02)


def test_the_dome_of_a_uniform_light_is_a_single_grey() -> None:
    picture, intensity = dome(Light(0.5 * np.eye(9)[0], 0.0))
    assert picture.shape == (HEIGHT_PX, 2 * HEIGHT_PX, 3)
    assert picture.min() >= 250 and abs(intensity - 0.5) < 0.01

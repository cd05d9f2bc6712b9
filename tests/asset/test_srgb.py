import numpy as np

from hnerf.asset.srgb import to_linear, to_srgb


def test_srgb_conversion_of_known_values() -> None:
    """By hand: ((0.5 + 0.055) / 1.055)^2.4 = 0.214041, and 12.92 x 0.002 = 0.02584 in the linear segment."""
    encoded, linear = np.array([0, 0.02584, 0.5, 1.0]), np.array([0, 0.002, 0.214041, 1.0])
    np.testing.assert_allclose(to_linear(encoded), linear, atol=1e-6)
    np.testing.assert_allclose(to_srgb(linear), encoded, atol=1e-6)


def test_colours_above_white_are_kept() -> None:
    np.testing.assert_allclose(to_srgb(to_linear(np.array([1.5]))), [1.5])

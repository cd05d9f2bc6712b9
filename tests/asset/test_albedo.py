"""Albedos of texels, worked out by hand, under light from above."""

import numpy as np

from hnerf.asset.albedo import AlbedoBlend, mean_irradiance
from hnerf.asset.light import Light
from hnerf.asset.photographs import FIELD_WEIGHT, SeenTexels, TexelPixels
from hnerf.asset.srgb import to_linear, to_srgb
from tests.asset.test_photographs import texels_at

ABOVE = Light(np.array([0.6, 0, 0.4 * 3**0.5 / 2, 0, 0, 0, 0, 0, 0]), 0.0)  # E = 0.6 + 0.4 z
UP, SIDE, DOWN = np.array([0.0, 0, 1]), np.array([1.0, 0, 0]), np.array([0.0, 0, -1])
ALBEDO = np.array([[0.8, 0.4, 0.2]])


def seen(normal: np.ndarray, colours: np.ndarray) -> SeenTexels:
    """Return what a photograph taken along the normal shows of the first texel."""
    return SeenTexels(TexelPixels(np.array([0]), np.array([0]), colours), np.ones(1), np.ones(1), normal[None], colours)


def test_albedo_is_recovered_from_any_illumination() -> None:
    """The same albedo, photographed in full light, half-light and shade, is recovered because each photograph has its
    own normal."""
    blend = AlbedoBlend(to_srgb(0.6 * ALBEDO), np.array([0.6]), ABOVE)
    for normal, irradiance in ((UP, 1.0), (SIDE, 0.6), (DOWN, 0.2)):
        blend.add(seen(normal, to_srgb(irradiance * ALBEDO)))
    np.testing.assert_allclose(to_linear(blend.colours()), ALBEDO, atol=1e-9)


def test_views_are_weighted_by_their_irradiance() -> None:
    """Two views and the field are averaged. One view has albedo 0.5 in full light, one 0.52 at irradiance 0.2; the
    field has 0.5, seen in half-light. Their mean is about (0.5 + 0.2 x 0.52 + FIELD_WEIGHT x 0.25) / (1.2 +
    FIELD_WEIGHT / 2): the second view differs from the field by 0.007 sqrt(3), less than a tenth of 0.15, so its weight
    is reduced by at most a hundredth."""
    blend = AlbedoBlend(np.full((1, 3), to_srgb(np.array(0.25))), np.array([0.5]), ABOVE)
    blend.add(seen(UP, np.full((1, 3), to_srgb(np.array(0.5)))))
    blend.add(seen(DOWN, np.full((1, 3), to_srgb(np.array(0.104)))))
    expected = (0.5 + 0.104 + FIELD_WEIGHT * 0.25) / (1.2 + FIELD_WEIGHT / 2)
    np.testing.assert_allclose(to_linear(blend.colours()), expected, atol=1e-4)


def test_unseen_texels_keep_the_fields_colour_without_its_light() -> None:
    blend = AlbedoBlend(to_srgb(0.2 * np.repeat(ALBEDO, 2, 0)), np.array([0.2, 0.5]), ABOVE)
    np.testing.assert_allclose(to_linear(blend.colours()), [ALBEDO[0], 0.4 * ALBEDO[0]], atol=1e-6)


def test_irradiance_is_the_mean_over_surfaces() -> None:
    """A triangle that faces up in one frame and down in the other."""
    corners_m = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    texels = texels_at([0], [[0.2, 0.3, 0.5]])
    found = mean_irradiance(ABOVE, [corners_m, corners_m * (1, -1, 1)], np.array([[0, 1, 2]]), texels)
    np.testing.assert_allclose(found, [(1 + 0.2) / 2], atol=1e-6)


def test_irradiance_uses_normalised_interpolated_normals() -> None:
    """The ridge of a roof has a normal half-way between up and +X. Half-way from the ridge to a corner that faces up,
    the normal is tilted by 22.5 degrees, where E = 0.6 + 0.4 cos."""
    corners_m = np.array([[-1.0, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1]])
    texels = texels_at([0], [[0.5, 0.25, 0.25]])
    found = mean_irradiance(ABOVE, [corners_m], np.array([[0, 1, 2], [1, 3, 2]]), texels)
    np.testing.assert_allclose(found, 0.6 + 0.4 * np.cos(np.pi / 8), atol=1e-6)

"""A light as a dome around the scene: an image of its radiance by longitude and latitude, for UsdLuxDomeLight."""

import numpy as np
from scipy.optimize import nnls

from hnerf.asset.light import REFLECTED, Light, harmonics
from hnerf.asset.srgb import to_srgb

HEIGHT_PX = 16  # of an image twice as wide: a light of order 2 has no detail
SMOOTHNESS = 1e-3  # weight of the squared radiance relative to the error of the light's coefficients


def dome(light: Light) -> tuple[np.ndarray, float]:
    """Return an image (H, 2 H, 3) uint8 sRGB and the intensity that it is multiplied by in linear light.

    The radiance of order 2 that gives a light's irradiance may be negative. The image shows the least non-negative
    radiance that has nearly the same irradiance everywhere (non-negative least squares, Lawson and Hanson 1974).
    """
    directions, share = dome_directions(HEIGHT_PX)
    gives = (harmonics(directions) * share[:, None]).T  # coefficients of a radiance
    weighed = REFLECTED[:, None] * gives
    smooth = SMOOTHNESS * np.diag(np.sqrt(share))
    target = np.concatenate([REFLECTED * light.coefficients, np.zeros(len(share))])
    radiance, _ = nnls(np.concatenate([weighed, smooth]), target)
    intensity = float(radiance.max())
    grey = np.round(255 * to_srgb(radiance / intensity)).astype(np.uint8).reshape(HEIGHT_PX, 2 * HEIGHT_PX, 1)
    return np.repeat(grey, 3, 2), intensity


def dome_directions(height_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions (N, 3), Y up, of the pixels of an image twice as wide as high, row by row, and the share of
    the sphere (N,) that each pixel covers.

    The middle column looks along +Z, and a quarter of the width to its left is +X, as in OpenEXR's latlong maps.
    """
    latitude = np.pi * (0.5 - (np.arange(height_px) + 0.5) / height_px)
    longitude = np.pi * (1 - (np.arange(2 * height_px) + 0.5) / height_px)
    up, around = (values.ravel() for values in np.meshgrid(latitude, longitude, indexing="ij"))
    directions = np.stack([np.cos(up) * np.sin(around), np.sin(up), np.cos(up) * np.cos(around)], 1)
    return directions, np.cos(up) / np.cos(up).sum()

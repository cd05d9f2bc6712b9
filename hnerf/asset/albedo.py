"""The albedo of texels: their colours in the photographs, divided by the irradiance at their normals there."""

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hnerf.asset.dome import dome
from hnerf.asset.light import Light
from hnerf.asset.photographs import FIELD_WEIGHT, BackProjection, SeenTexels
from hnerf.asset.srgb import to_linear, to_srgb
from hnerf.asset.tangents import unit
from hnerf.asset.texture import Texels
from hnerf.body.descriptor import normals_of


@dataclass(frozen=True)
class Albedo:
    """A texture (H, W, 3) uint8 sRGB without the recording's light, and that light."""

    texture: np.ndarray
    light: Light

    @cached_property
    def dome(self) -> tuple[np.ndarray, float]:
        """Return the light as an image and its intensity, as `hnerf.asset.dome.dome` does."""
        return dome(self.light)


class AlbedoBlend:
    """The mean albedo of texels over photographs, in linear light. The weights of `CapturedBlend` are multiplied by the
    irradiance, since noise matters less in bright light. The field's colours (N, 3), seen at irradiances (N,), have a
    small weight everywhere."""

    def __init__(self, field_colours: np.ndarray, field_irradiance: np.ndarray, light: Light) -> None:
        self._light = light
        seen = to_linear(field_colours)
        self._field = (seen / field_irradiance[:, None]).astype(np.float32)
        self._irradiance = FIELD_WEIGHT * field_irradiance[:, None]
        self._total = FIELD_WEIGHT * seen
        self._projection = BackProjection()

    def add(self, seen: SeenTexels) -> None:
        """Add a photograph."""
        irradiance = self._light.irradiance(seen.normals).astype(np.float32)[:, None]
        counts = seen.weights(to_srgb(self._field.take(seen.index, 0) * irradiance))
        self._irradiance[seen.index] += counts * irradiance
        self._total[seen.index] += counts * to_linear(seen.colours)
        pixels = dataclasses.replace(seen.pixels, colours=to_linear(seen.pixels.colours))
        self._projection.add(pixels, counts, irradiance)

    def colours(self) -> np.ndarray:
        """Return the albedos (N, 3) as sRGB in [0, 1]."""
        return to_srgb(self._projection.sharpened(self._total / self._irradiance, self._irradiance))


def mean_irradiance(light: Light, surfaces_m: Iterable[np.ndarray], faces: np.ndarray, texels: Texels) -> np.ndarray:
    """Return the mean irradiance (N,) of texels over several posed surfaces (V, 3)."""
    normals = [unit(texels.interpolate(normals_of(surface_m, faces), faces)) for surface_m in surfaces_m]
    return np.mean([light.irradiance(of_texels) for of_texels in normals], 0)

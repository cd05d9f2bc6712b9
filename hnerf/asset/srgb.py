"""The encoding of images: sRGB (IEC 61966-2-1). Values are from 0 to 1."""

import numpy as np


def to_linear(encoded: np.ndarray) -> np.ndarray:
    """Decode sRGB values to ones that are proportional to light."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded.clip(0) + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """Encode values that are proportional to light."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clip(0.0031308) ** (1 / 2.4) - 0.055)

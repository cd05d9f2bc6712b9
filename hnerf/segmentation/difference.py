"""Image against clean plate: what changed, and which of that is only a shadow."""

from dataclasses import dataclass

import cv2
import numpy as np

from hnerf.config import SegmentationSettings
from hnerf.segmentation.prior import Prior

LEAST_DIFFERENCE = 5.0  # grey levels: below it JPEG and rounding
ROUNDING = 0.5  # grey levels
HIDDEN = 256  # sorts behind every grey level
NOISE_FACTOR = 1.5  # standard deviations of a pixel's noise; the mean of nine has a third of it
CHROMA_PER_DARKENING = 0.04  # gamma and stray light tint deep shadows a little


@dataclass(frozen=True)
class Difference:
    """changed, shadow (H, W) bool; shadow lies within changed."""

    changed: np.ndarray
    shadow: np.ndarray


def noise_level(image: np.ndarray, plate: np.ndarray) -> float:
    """Standard deviation of their difference, grey levels; most of the image must be background."""
    apart = image[::4, ::4].astype(np.float32) - plate[::4, ::4]
    return 1.4826 * float(np.median(np.abs(apart))) + ROUNDING


def difference(image: np.ndarray, plate: np.ndarray, noise: float, settings: SegmentationSettings) -> Difference:
    """Compare (H, W, 3) uint8 RGB images.

    A shadow multiplies the plate, and all channels nearly alike: it is where the log ratio's brightness falls, not too
    far, while its chroma stays (Horprasert et al. 1999, in logarithms).
    """
    image, plate = image.astype(np.float32), plate.astype(np.float32)
    apart = image - plate
    single = np.abs(apart).max(-1)
    smooth = np.abs(cv2.blur(apart, (3, 3))).max(-1)
    least = max(LEAST_DIFFERENCE, NOISE_FACTOR * noise)
    changed = (smooth > least) & (single > 0.6 * least)
    ratio = cv2.blur(np.log((image + 1) / (plate + 1)), (3, 3))
    brightness = ratio.mean(-1)
    chroma = np.linalg.norm(ratio - brightness[..., None], axis=-1)
    chroma_noise = 2 * noise / (plate.min(-1) + 1)
    tint = np.maximum(settings.shadow_chroma, chroma_noise) - CHROMA_PER_DARKENING * brightness
    shadow = (chroma < tint) & (brightness < 0) & (brightness > np.log(settings.darkest_shadow))
    return Difference(changed, changed & shadow)


def masked_median(images: list[np.ndarray], priors: list[Prior]) -> tuple[np.ndarray, np.ndarray]:
    """The background of a fixed camera without a clean plate: (H, W, 3) uint8 RGB, and (H, W) bool where it is known.

    The median over time of each pixel in the frames in which the person is not near it.
    """
    hidden = np.stack([prior.near for prior in priors])
    seen = (~hidden).sum(0)
    plate = np.empty_like(images[0])
    for row in range(plate.shape[0]):  # row by row bounds the memory
        values = np.stack([image[row] for image in images]).astype(np.int16)
        values[hidden[:, row]] = HIDDEN
        middle = np.sort(values, axis=0)[seen[row] // 2, np.arange(plate.shape[1])]
        plate[row] = np.where(seen[row, :, None] > 0, middle, 0)
    return plate, seen > 0

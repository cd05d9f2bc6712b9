"""Image against background: how much likelier each pixel is the person's than the background's, or its shadow's."""

from dataclasses import dataclass

import cv2
import numpy as np

from hnerf.config import SegmentationSettings
from hnerf.segmentation.prior import Prior

DARK = 6.0  # grey levels added before the logarithm: below it sensors and JPEG tell little
RATIO_NOISE = 0.01  # of log ratios, beyond the pixel's own noise: JPEG, rounding of the plate
SHADOW_TINT = 0.02  # change of log chroma per log brightness: gamma and stray light tint deep shadows a little
SHADOW_SHARE = 0.1  # of the background near a person, before looking
EDGE_OF_SHADOW = 0.1  # log brightness over which a shadow beyond the darkest becomes impossible
PERSON_BRIGHTNESS, PERSON_CHROMA = 0.6, 0.25  # spread of a person's log ratio to what is behind
NOISE_FACTOR = 0.8  # the robust estimate of noise counts JPEG's blocks twice
ROUNDING = 0.5  # grey levels
MOST, ENOUGH = 0.5, 0.02  # of an image, to tell noise and exposure by
EACH = 15  # pixel is enough for a median
ALIKE = 0.02  # of exposures: noise and JPEG feign as much
APART_GAIN, APART_FLOOR = 16.0, 16.0  # of the picture of differences, which cameras' square-root noise makes even
PAINT_PX = 3  # from which a pixel never seen takes its colour
HIDDEN = 256  # sorts behind every grey level


@dataclass(frozen=True)
class Difference:
    """odds: (H, W) float32, logarithm of the odds of person against background, shadows included. apart: (H, W, 3)
    uint8, the difference as a picture, grey where nothing changed. plate: (H, W, 3) uint8 RGB, as compared to."""

    odds: np.ndarray
    apart: np.ndarray
    plate: np.ndarray


def surroundings(prior: Prior, known: np.ndarray) -> np.ndarray:
    """(H, W) bool: where background is seen and `known`, as far from the person as there is enough of it."""
    for free in (~prior.reach & known, ~prior.near & known):
        if free.mean() > ENOUGH:
            return free
    return ~prior.body & known


def exposure_corrected(plate: np.ndarray, image: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The plate as bright and as tinted as the image is where it shows background, `free` (H, W): cameras that expose
    by themselves do so anew when a person comes in. As it is where they are alike."""
    if not free.any():
        return plate
    gains = np.median((image[free][::EACH] + DARK) / (plate[free][::EACH] + DARK), 0)
    if np.abs(gains - 1).max() < ALIKE:
        return plate
    return ((plate + DARK) * gains - DARK).round().clip(0, 255).astype(np.uint8)


def noise_level(image: np.ndarray, plate: np.ndarray, free: np.ndarray) -> float:
    """Standard deviation of their difference where both show background, `free` (H, W); grey levels. In all of a
    picture most of which is free: what shadows change is then in the noise, and not taken for the person."""
    free = np.ones_like(free) if free.mean() > MOST else free
    apart = image[free][::EACH].astype(np.float32) - plate[free][::EACH]
    return (1.4826 * float(np.median(np.abs(apart))) if len(apart) else 0.0) + ROUNDING


def difference(
    image: np.ndarray, plate: np.ndarray, noise: float, settings: SegmentationSettings, shadowed: bool = False
) -> Difference:
    """Compare (H, W, 3) uint8 RGB images. `shadowed`: the plate, a median over time, may hold shadows itself.

    The logarithm of their ratio splits into brightness and chroma. Unchanged background has neither; a shadow takes
    brightness away and leaves chroma nearly alone (Horprasert et al. 1999, in logarithms); a person may have any.
    """
    lit, unlit = image.astype(np.float32) + DARK, plate.astype(np.float32) + DARK
    ratio = np.log(lit / unlit)
    brightness = ratio.mean(-1)
    chroma = ((ratio - brightness[..., None]) ** 2).sum(-1)
    noise_variance = (NOISE_FACTOR * noise / unlit.min(-1)) ** 2 + RATIO_NOISE**2
    unchanged = _normal(3 * brightness**2, noise_variance, 1) + _normal(chroma, noise_variance, 2)
    tint = noise_variance + settings.shadow_chroma**2 + (SHADOW_TINT * np.minimum(brightness, 0)) ** 2
    darkest = float(np.log(settings.darkest_shadow))
    shadow = _even(brightness, darkest, -darkest if shadowed else 0.0) + _normal(chroma, tint, 2)
    background = np.logaddexp(np.log(1 - SHADOW_SHARE) + unchanged, np.log(SHADOW_SHARE) + shadow)
    person = _normal(3 * brightness**2, 3 * PERSON_BRIGHTNESS**2, 1) + _normal(chroma, PERSON_CHROMA**2, 2)
    apart = APART_GAIN * (image.astype(np.float32) - plate) / np.sqrt(plate + APART_FLOOR)
    picture = (128 + apart).clip(0, 255).round().astype(np.uint8)
    return Difference((person - background).astype(np.float32), picture, plate)


def _normal(squared: np.ndarray, variance: np.ndarray | float, dimensions: int) -> np.ndarray:
    """Logarithm of the normal density at this squared distance."""
    return -0.5 * squared / variance - 0.5 * dimensions * np.log(2 * np.pi * variance)


def _even(brightness: np.ndarray, low: float, high: float) -> np.ndarray:
    """Logarithm of a density of log brightness that is even from low to high, soft at both ends."""
    beyond = (np.maximum(low - brightness, 0) + np.maximum(brightness - high, 0)) / EDGE_OF_SHADOW
    return -0.5 * beyond**2 - np.log(np.sqrt(3) * (high - low))


def masked_median(images: list[np.ndarray], priors: list[Prior]) -> tuple[np.ndarray, np.ndarray]:
    """The background of a fixed camera without a clean plate: (H, W, 3) uint8 RGB, and (H, W) bool where it is known.

    The median over time of each pixel in the frames in which the person is not near it; where there is no such frame,
    painted in from around (Telea 2004).
    """
    hidden = np.stack([prior.near for prior in priors])
    seen = (~hidden).sum(0)
    plate = np.empty_like(images[0])
    for row in range(plate.shape[0]):  # row by row bounds the memory
        values = np.stack([image[row] for image in images]).astype(np.int16)
        values[hidden[:, row]] = HIDDEN
        middle = np.sort(values, axis=0)[seen[row] // 2, np.arange(plate.shape[1])]
        plate[row] = middle.clip(0, 255)
    return cv2.inpaint(plate, (seen == 0).astype(np.uint8), PAINT_PX, cv2.INPAINT_TELEA), seen > 0

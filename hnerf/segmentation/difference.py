"""Image against background: log odds that each pixel shows the person rather than the background, shadowed or not."""

from dataclasses import dataclass

import cv2
import numpy as np

from hnerf.capture.capture import to_8_bit
from hnerf.segmentation.prior import Prior

LOG_OFFSET = 6.0  # grey levels added before the logarithm: below them sensors and JPEG carry little information
RATIO_NOISE = 0.01  # of log ratios, in addition to the pixel's own noise: JPEG, rounding of the plate
SHADOW_CHROMA = 0.01  # std of log colour ratios in a shadow, beyond noise
DARKEST_SHADOW = 0.3  # share of the brightness that is left in the deepest shadow
SHADOW_TINT = 0.02  # log chroma per log brightness: gamma and stray light tint deep shadows a little
SHADOW_SHARE = 0.1  # prior share of the background near a person
MAX_GREY_SPREAD = 6  # grey levels between the channels of a grey image: videos round its chroma, by 3 levels
GREY_SHADOW_SHARE = 0.3  # in grey images, in which no chroma distinguishes a shadow from the person
EDGE_OF_SHADOW = 0.1  # log brightness over which the density of shadows falls off beyond the darkest one
PERSON_BRIGHTNESS, PERSON_CHROMA = 0.6, 0.25  # standard deviations of a person's log ratio to the background
NOISE_FACTOR = 0.8  # the robust estimate of noise counts JPEG's blocks twice
ROUNDING = 0.5  # grey levels
MOSTLY_FREE, MIN_FREE = 0.5, 0.02  # shares of an image: to estimate noise, and exposure
PIXEL_STRIDE = 15  # every 15th pixel is enough for a median
MIN_GAIN = 0.02  # deviation of gains from one; noise and JPEG can cause smaller ones
CONTRAST_GAIN, CONTRAST_FLOOR = 16.0, 16.0  # of the contrast image, which equalises cameras' square-root noise
INPAINT_RADIUS_PX = 3  # for pixels that are never seen
HIDDEN_LEVEL = 256  # sorts after every grey level


@dataclass(frozen=True)
class Difference:
    """The comparison of an image with a plate. log_odds: (H, W) float32, of person against background, including
    shadows; contrast: (H, W, 3) uint8, the difference as an image, grey where nothing changed; plate: (H, W, 3) uint8
    RGB, as compared."""

    log_odds: np.ndarray
    contrast: np.ndarray
    plate: np.ndarray


def visible_background(prior: Prior, known: np.ndarray) -> np.ndarray:
    """Return where background is visible and `known`, (H, W) bool: as far from the person as possible while enough of
    it remains."""
    for free in (~prior.reach & known, ~prior.near & known):
        if free.mean() > MIN_FREE:
            return free
    return ~prior.body & known


def exposure_corrected(plate: np.ndarray, image: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return the plate with the image's brightness and tint, measured on visible background, `free` (H, W).

    Automatic exposure changes when a person comes in. The plate is returned unchanged if the gains are near one.
    """
    if not free.any():
        return plate
    gains = np.median((_some(image, free) + LOG_OFFSET) / (_some(plate, free) + LOG_OFFSET), 0)
    if np.abs(gains - 1).max() < MIN_GAIN:
        return plate
    return to_8_bit((plate + LOG_OFFSET) * gains - LOG_OFFSET)


def noise_level(image: np.ndarray, plate: np.ndarray, free: np.ndarray) -> float:
    """Return the standard deviation, in grey levels, of image minus plate where both show background, `free` (H, W).

    The whole image is used if most of it is free: changes by shadows then count as noise, not as the person.
    """
    free = np.ones_like(free) if free.mean() > MOSTLY_FREE else free
    contrast = _some(image, free).astype(np.float32) - _some(plate, free)
    return (1.4826 * float(np.median(np.abs(contrast))) if len(contrast) else 0.0) + ROUNDING


def _some(image: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return every PIXEL_STRIDE-th of the pixels `where` (H, W) bool of an image (H, W, 3), (N, 3)."""
    return image.reshape(-1, 3)[np.flatnonzero(where)[::PIXEL_STRIDE]]


def difference(image: np.ndarray, plate: np.ndarray, noise: float, shadowed: bool = False) -> Difference:
    """Compare images (H, W, 3) uint8 RGB. `shadowed`: the plate, a median over time, may contain shadows itself.

    The logarithm of their ratio splits into brightness and chroma. Unchanged background has neither; a shadow lowers
    the brightness and hardly changes the chroma (Horprasert et al. 1999, in logarithms); a person may have any
    brightness and chroma, but in a grey image no chroma.
    """
    lit, unlit = image.astype(np.float32) + LOG_OFFSET, plate.astype(np.float32) + LOG_OFFSET
    ratio = np.log(lit / unlit)
    brightness = ratio.mean(-1)
    chroma = ((ratio - brightness[..., None]) ** 2).sum(-1)
    noise_variance = (NOISE_FACTOR * noise / unlit.min(-1)) ** 2 + RATIO_NOISE**2
    unchanged = _log_gaussian(3 * brightness**2, noise_variance, 1) + _log_gaussian(chroma, noise_variance, 2)
    tint = noise_variance + SHADOW_CHROMA**2 + (SHADOW_TINT * np.minimum(brightness, 0)) ** 2
    darkest = float(np.log(DARKEST_SHADOW))
    shadow = _log_uniform(brightness, darkest, -darkest if shadowed else 0.0) + _log_gaussian(chroma, tint, 2)
    grey = (image.max(-1) - image.min(-1)).max() <= MAX_GREY_SPREAD
    share, tones = (GREY_SHADOW_SHARE, tint) if grey else (SHADOW_SHARE, PERSON_CHROMA**2)
    background = np.logaddexp(np.log(1 - share) + unchanged, np.log(share) + shadow)
    person = _log_gaussian(3 * brightness**2, 3 * PERSON_BRIGHTNESS**2, 1) + _log_gaussian(chroma, tones, 2)
    contrast = CONTRAST_GAIN * (image.astype(np.float32) - plate) / np.sqrt(plate + CONTRAST_FLOOR)
    return Difference((person - background).astype(np.float32), to_8_bit(128 + contrast), plate)


def _log_gaussian(squared: np.ndarray, variance: np.ndarray | float, dimensions: int) -> np.ndarray:
    """Return the logarithm of the Gaussian density at a squared distance."""
    return -0.5 * squared / variance - 0.5 * dimensions * np.log(2 * np.pi * variance)


def _log_uniform(brightness: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return the logarithm of a density over log brightness that is uniform from low to high, with soft ends."""
    beyond = (np.maximum(low - brightness, 0) + np.maximum(brightness - high, 0)) / EDGE_OF_SHADOW
    return -0.5 * beyond**2 - np.log(np.sqrt(3) * (high - low))


def masked_median(images: list[np.ndarray], hidden: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the background of a fixed camera without a clean plate, (H, W, 3) uint8 RGB, and where it is known, (H, W)
    bool.

    It is each pixel's median over the frames in which it is not `hidden` (H, W) bool, the lighter of two middle values:
    the mean of one in a shadow and one outside it would be neither. Pixels without such a frame are inpainted (Telea
    2004).
    """
    behind = np.stack(hidden)
    seen = (~behind).sum(0)
    plate = np.empty_like(images[0])
    for row in range(plate.shape[0]):  # row by row bounds the memory
        values = np.stack([image[row] for image in images]).astype(np.int16)
        values[behind[:, row]] = HIDDEN_LEVEL
        middle = np.sort(values, axis=0)[seen[row] // 2, np.arange(plate.shape[1])]
        plate[row] = middle.clip(0, 255)
    return cv2.inpaint(plate, (seen == 0).astype(np.uint8), INPAINT_RADIUS_PX, cv2.INPAINT_TELEA), seen > 0

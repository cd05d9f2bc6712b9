"""Where exactly a mask ends: pixels at its edge mix the person with what is behind, and belong to whom they show more
of."""

import cv2
import numpy as np

BAND_PX = 2.0  # from the edge, on both sides: what may change hands
PURE_PX = 1.2  # from the edge, beyond which a pixel is taken to be unmixed
NEARBY_PX = 1.0  # standard deviation of the neighbourhood that says what the unmixed colours are
BLUR_PX = 0.5  # of evidence along the edge
DOUBT = 100.0  # squared grey levels between the two colours from which they tell more than the mask did
BESIDE_PX = 3.0  # from the edge, up to which a pixel tells what is beside the mask
UNLIKE = 0.1  # median deviation of log ratios to the plate there: below 0.03 in good masks, above 0.15 in small ones
DARK = 8.0  # grey levels added before the logarithm
# Luma, and chroma twice: the person's own shading changes brightness rather than colour.
COLOUR = np.array([[0.299, 0.587, 0.114], [-0.338, -0.662, 1.0], [1.0, -0.838, -0.162]], np.float32)


def settle_edge(mask: np.ndarray, image: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """The mask (H, W) bool with its edge where the person covers half a pixel; image, plate (H, W, 3) RGB.

    A pixel is coverage * person + (1 - coverage) * background (Porter and Duff 1984). The person's colour is that of
    pixels just inside; the background is the plate, darkened as just outside. Coverage is the least-squares solution.
    """
    inside, outside = (cv2.distanceTransform(m.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5) for m in (mask, ~mask))
    person, _ = _nearby(image.astype(np.float32), inside > PURE_PX)
    background = shaded_plate(mask, image, plate)
    apart, mixed = (person - background) @ COLOUR.T, (image - background) @ COLOUR.T
    evidence = cv2.GaussianBlur(np.stack([(apart * mixed).sum(-1), (apart**2).sum(-1), mask], -1, dtype=np.float32),
                                (0, 0), BLUR_PX)  # fmt: skip
    coverage = (evidence[..., 0] + DOUBT * evidence[..., 2]) / (evidence[..., 1] + DOUBT)
    mixing = (inside <= BAND_PX) & (outside <= BAND_PX)
    return np.where(mixing, coverage >= 0.5, mask)


def shaded_plate(mask: np.ndarray, image: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """What is behind the pixels at a mask's edge, (H, W, 3) float32 RGB: the plate, as much darker or brighter as the
    image is just outside the mask (H, W) bool, where shadows fall on it. The plate as it is where the mask ends within
    the person, who is then beside it: most of an outline is in no shadow, and there all ratios to the plate are alike.
    """
    image, plate = image.astype(np.float32) + DARK, plate.astype(np.float32) + DARK
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    ratio = np.log(image / plate)
    beside = ratio.mean(-1)[(outside > PURE_PX) & (outside <= BESIDE_PX)]
    if len(beside) and np.median(np.abs(beside - np.median(beside))) > UNLIKE:
        return plate - DARK
    darkening, weight = _nearby(ratio, outside > PURE_PX)
    return plate * np.exp(np.where(weight[..., None] > 0, darkening, 0)) - DARK


def _nearby(values: np.ndarray, pure: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean of values (H, W, C) over the pure pixels (H, W) bool near each pixel, with their weight (H, W); the mean of
    a wider neighbourhood where there are none."""
    total, mean = np.zeros(pure.shape, np.float32), np.zeros_like(values)
    for radius_px, share in ((3 * NEARBY_PX, 1e-4), (NEARBY_PX, 1.0)):
        weight = share * cv2.GaussianBlur(pure.astype(np.float32), (0, 0), radius_px)
        mean += share * cv2.GaussianBlur(values * pure[..., None], (0, 0), radius_px)
        total += weight
    return mean / np.maximum(total, 1e-9)[..., None], total

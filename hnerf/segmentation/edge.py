"""The exact edge of a mask: its pixels mix person and background, and belong to the one that covers more of them."""

import cv2
import numpy as np

BAND_PX = 2.0  # pixels up to this distance from the edge, on both sides, may change
UNMIXED_PX = 1.2  # from the edge, beyond which pixels count as unmixed
NEARBY_PX = 1.0  # standard deviation of the neighbourhood from which unmixed colours are taken
BLUR_PX = 0.5  # of evidence along the edge
REGULARISATION = 100.0  # squared grey levels between the two colours at which the evidence weighs as much as the mask
BESIDE_PX = 3.0  # from the edge, up to which pixels count as just outside the mask
MAX_DEVIATION = 0.1  # median of log ratios to the plate there: below 0.03 for good masks, above 0.15 for too small ones
LOG_OFFSET = 8.0  # grey levels added before the logarithm
# Luma, and chroma twice: the person's own shading changes brightness rather than colour.
COLOUR = np.array([[0.299, 0.587, 0.114], [-0.338, -0.662, 1.0], [1.0, -0.838, -0.162]], np.float32)


def refine_edge(mask: np.ndarray, image: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """Return the mask (H, W) bool with its edge where the person covers half a pixel; image, plate (H, W, 3) RGB.

    A pixel is coverage * person + (1 - coverage) * background (Porter and Duff 1984). The person's colour is taken from
    pixels just inside; the background is the plate, darkened as just outside the mask. Coverage is the least-squares
    solution.
    """
    inside, outside = (cv2.distanceTransform(m.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5) for m in (mask, ~mask))
    person, _ = _local_mean(image.astype(np.float32), inside > UNMIXED_PX)
    background = shaded_plate(mask, image, plate)
    apart, mixed = (person - background) @ COLOUR.T, (image - background) @ COLOUR.T
    evidence = cv2.GaussianBlur(np.stack([(apart * mixed).sum(-1), (apart**2).sum(-1), mask], -1, dtype=np.float32),
                                (0, 0), BLUR_PX)  # fmt: skip
    coverage = (evidence[..., 0] + REGULARISATION * evidence[..., 2]) / (evidence[..., 1] + REGULARISATION)
    mixing = (inside <= BAND_PX) & (outside <= BAND_PX)
    return np.where(mixing, coverage >= 0.5, mask)


def shaded_plate(mask: np.ndarray, image: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """Return the background behind the pixels at a mask's edge, (H, W, 3) float32 RGB: the plate, scaled by the
    brightness of the image just outside the mask (H, W) bool, where shadows fall on it.

    The plate is returned unchanged if the mask ends within the person, who is then just outside it. Ratios to the plate
    that vary widely show this: most of an outline is not in shadow, so around a good mask they are alike.
    """
    image, plate = image.astype(np.float32) + LOG_OFFSET, plate.astype(np.float32) + LOG_OFFSET
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    ratio = np.log(image / plate)
    beside = ratio.mean(-1)[(outside > UNMIXED_PX) & (outside <= BESIDE_PX)]
    if len(beside) and np.median(np.abs(beside - np.median(beside))) > MAX_DEVIATION:
        return plate - LOG_OFFSET
    darkening, weight = _local_mean(ratio, outside > UNMIXED_PX)
    return plate * np.exp(np.where(weight[..., None] > 0, darkening, 0)) - LOG_OFFSET


def _local_mean(values: np.ndarray, unmixed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of values (H, W, C) over the unmixed pixels (H, W) bool near each pixel, and their weight (H, W);
    of a wider neighbourhood if there are none near."""
    total, mean = np.zeros(unmixed.shape, np.float32), np.zeros_like(values)
    for radius_px, share in ((3 * NEARBY_PX, 1e-4), (NEARBY_PX, 1.0)):
        weight = share * cv2.GaussianBlur(unmixed.astype(np.float32), (0, 0), radius_px)
        mean += share * cv2.GaussianBlur(values * unmixed[..., None], (0, 0), radius_px)
        total += weight
    return mean / np.maximum(total, 1e-9)[..., None], total

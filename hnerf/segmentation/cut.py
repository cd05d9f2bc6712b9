"""A mask from a difference and a prior: smoothed log odds, GrabCut where they are uncertain, matting at the edge."""

import cv2
import numpy as np

from hnerf.segmentation.difference import Difference
from hnerf.segmentation.edge import refine_edge
from hnerf.segmentation.prior import Prior, bounding_window, disc

BODY_LOG_ODDS, CORE_LOG_ODDS = 1.0, 2.0  # added by the prior on the body, and again on its core
UNKNOWN_LOG_ODDS = -2.0  # off the body, where the plate is unknown
MAX_LOG_ODDS = 4.0  # of one pixel: the noise and shadow models are no more certain than this
SURE_LOG_ODDS = 2.0  # beyond which GrabCut may not change the label
SMOOTH_PX, SMOOTH_GREY = 2, 7.0  # the guided filter's window, and the image step that it preserves
SPECK_SHARE = 0.001  # of the mask's area: smaller components are noise
BAND_PX = 4  # width around the likely person in which GrabCut may add to it


def cut(image: np.ndarray, found: Difference, prior: Prior, known: np.ndarray) -> np.ndarray:
    """Return the mask of the person, (H, W) bool, in an RGB image. `known` (H, W) bool: where the plate behind `found`
    is valid.

    The log odds, with those of the prior, are averaged by a guided filter (cost-volume filtering, Rhemann et al. 2011)
    and label the pixels that are certain. GrabCut (Rother et al. 2004) decides the rest on the contrast image, which is
    free of the background's texture.
    """
    log_odds = np.where(known, found.log_odds.clip(-MAX_LOG_ODDS, MAX_LOG_ODDS), UNKNOWN_LOG_ODDS * ~prior.body)
    log_odds = log_odds + BODY_LOG_ODDS * prior.body + CORE_LOG_ODDS * prior.core
    log_odds = cv2.ximgproc.guidedFilter(found.contrast, log_odds.astype(np.float32), SMOOTH_PX, SMOOTH_GREY**2)
    likely = components_within((log_odds > 0) & prior.reach, prior.reach)
    if not likely.any():
        return likely
    labels = np.where(log_odds > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    around = cv2.dilate(likely.astype(np.uint8), disc(BAND_PX)).astype(bool) | (~known & prior.near)
    labels[(log_odds < -SURE_LOG_ODDS) | ~around | ~prior.reach] = cv2.GC_BGD
    labels[cv2.erode((log_odds > SURE_LOG_ODDS).astype(np.uint8), disc(1)).astype(bool) & prior.reach] = cv2.GC_FGD
    labels = _grab_cut(found.contrast, labels)
    mask = components_within((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD), prior.reach)
    return refine_edge(_without_specks(mask), image, found.plate)


def _without_specks(mask: np.ndarray) -> np.ndarray:
    """Return a mask without its smallest components."""
    _, parts, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    large = stats[:, cv2.CC_STAT_AREA] >= SPECK_SHARE * mask.sum()
    large[0] = False
    return large[parts]


def _grab_cut(picture: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return labels after GrabCut on a tight window, so that its background model describes the person's
    surroundings."""
    window = bounding_window(labels != cv2.GC_BGD)
    inside = np.ascontiguousarray(labels[window])
    if not np.isin(inside, (cv2.GC_BGD, cv2.GC_PR_BGD)).any():  # the person fills the image
        return labels
    cv2.setRNGSeed(0)  # for the k-means that initialises its colour models
    background, person = np.zeros((1, 65)), np.zeros((1, 65))
    pixels = np.ascontiguousarray(picture[window])
    cv2.grabCut(pixels, inside, (0, 0, 0, 0), background, person, 1, cv2.GC_INIT_WITH_MASK)
    result = labels.copy()
    result[window] = inside
    return result


def components_within(mask: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return the connected components of a mask that lie at least half within reach: the subject, not other people."""
    count, parts = cv2.connectedComponents(mask.astype(np.uint8))
    area = np.bincount(parts.ravel(), minlength=count)
    inside = np.bincount(parts[reach], minlength=count)
    kept = 2 * inside >= area
    kept[0] = False
    return kept[parts]

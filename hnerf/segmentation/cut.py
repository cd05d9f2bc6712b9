"""From a difference and a prior to a mask: labels, then GrabCut in the band where they are unsure."""

import cv2
import numpy as np

from hnerf.segmentation.difference import Difference
from hnerf.segmentation.prior import Prior, disc, window_around

ITERATIONS = 2  # the labels are nearly right: more let the colour models drift
SHADOW_SHARE = 0.006  # of the person's height: thinner shadows are the person's own dark edges
BAND_SHARE = 0.005  # of the person's height, on both sides of the outline: what GrabCut decides


def cut(image: np.ndarray, found: Difference, prior: Prior, known: np.ndarray) -> np.ndarray:
    """Mask of the person, (H, W) bool, in an RGB image. `known` (H, W) bool: where the plate behind `found` is one."""
    likely = _likely_person(found, prior, known)
    if not likely.any():
        return likely
    band = disc(max(2, BAND_SHARE * prior.height_px))
    grown = cv2.dilate(likely.astype(np.uint8), band).astype(bool)
    shrunk = cv2.erode(likely.astype(np.uint8), band).astype(bool)
    labels = np.full(likely.shape, cv2.GC_BGD, np.uint8)
    labels[grown & found.changed & prior.reach | ~known & prior.near] = cv2.GC_PR_BGD
    labels[likely] = cv2.GC_PR_FGD
    labels[shrunk & (known | prior.core)] = cv2.GC_FGD
    labels = _grab_cut(image, labels)
    mask = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    return components_within(mask, prior.reach)


def _likely_person(found: Difference, prior: Prior, known: np.ndarray) -> np.ndarray:
    """Changed and no shadow, within reach, without specks and pin holes; the body itself where there is no plate."""
    thin = disc(SHADOW_SHARE * prior.height_px)
    shadow = cv2.morphologyEx((found.shadow & ~prior.core).astype(np.uint8), cv2.MORPH_OPEN, thin).astype(bool)
    lit = found.changed & ~shadow
    likely = np.where(known, lit & prior.reach, prior.body)
    opened = cv2.morphologyEx(likely.astype(np.uint8), cv2.MORPH_OPEN, disc(1))
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, thin).astype(bool)
    return opened.astype(bool) | (closed & (lit | ~known))


def _grab_cut(image: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Labels after GrabCut, which sees a tight window: its model of the background is of what surrounds the person."""
    window = window_around(labels != cv2.GC_BGD)
    inside = np.ascontiguousarray(labels[window])
    if not np.isin(inside, (cv2.GC_BGD, cv2.GC_PR_BGD)).any():
        return labels
    cv2.setRNGSeed(0)  # its colour models start from k-means
    background, person = np.zeros((1, 65)), np.zeros((1, 65))
    pixels = np.ascontiguousarray(image[window])
    cv2.grabCut(pixels, inside, (0, 0, 0, 0), background, person, ITERATIONS, cv2.GC_INIT_WITH_MASK)
    result = labels.copy()
    result[window] = inside
    return result


def components_within(mask: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """The connected parts of a mask that lie at least half within reach: the subject, not other people."""
    count, parts = cv2.connectedComponents(mask.astype(np.uint8))
    area = np.bincount(parts.ravel(), minlength=count)
    inside = np.bincount(parts[reach], minlength=count)
    kept = 2 * inside >= area
    kept[0] = False
    return kept[parts]

"""Degradations of masks: too small, too large, with holes, or without a limb.

They raise NotApplicableError if no mask would change, for example if a share of a small image's width is less than a
pixel: scores would only repeat those of the reference.
"""

from collections.abc import Callable

import cv2
import numpy as np

from hnerf.capture.body_25 import LEFT_ARM, LEFT_LEG, RIGHT_ARM, RIGHT_LEG
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks, encode
from hnerf.capture.subject import subject_keypoints
from hnerf.errors import NotApplicableError

LIMBS = (RIGHT_ARM[1], LEFT_ARM[1], RIGHT_LEG[1], LEFT_LEG[1])  # forearms and shins
BEYOND = 0.5  # as a share of a limb's length: where the hand or foot ends
THICKNESS = 0.8  # of the part that is cut, as a share of a limb's length
HOLE_RADIUS = 0.1  # as a share of the square root of a mask's area

MaskChange = Callable[[str, int, np.ndarray], np.ndarray]


def erode(masks: Masks, capture: Capture, percent: float, rng: np.random.Generator) -> Masks:
    """Remove the pixels of the mask that are within this percentage of the image's width from its edge."""
    return _changed(masks, capture, lambda _, __, mask: _edge_distance_px(mask) > percent / 100 * mask.shape[1])


def dilate(masks: Masks, capture: Capture, percent: float, rng: np.random.Generator) -> Masks:
    """Add the pixels that are within this percentage of the image's width from the person."""
    return _changed(masks, capture, lambda _, __, mask: _edge_distance_px(~mask) <= percent / 100 * mask.shape[1])


def cut_holes(masks: Masks, capture: Capture, percent: float, rng: np.random.Generator) -> Masks:
    """Remove discs at random places until this percentage of each mask is gone."""
    return _changed(masks, capture, lambda _, __, mask: _with_holes(mask, percent / 100, rng))


def cut_limb(masks: Masks, capture: Capture, percent: float, rng: np.random.Generator) -> Masks:
    """Remove a forearm with its hand, or a lower leg with its foot, from this percentage of the masks, at random.

    Raises NotApplicableError if there are no keypoints, which locate the limbs.
    """
    if not capture.has_keypoints:
        raise NotApplicableError(f"{capture.name}: has no keypoints, which locate the limbs")
    keypoints = subject_keypoints(capture)

    def cut(camera: str, frame: int, mask: np.ndarray) -> np.ndarray:
        hit, limb = rng.random() < percent / 100, LIMBS[rng.integers(len(LIMBS))]
        person = keypoints[camera][capture.frames.index(frame)]
        return mask & ~_limb(person, limb, mask.shape) if hit else mask

    return _changed(masks, capture, cut)


def _changed(masks: Masks, capture: Capture, change: MaskChange) -> Masks:
    changed, differ = dict[tuple[str, int], bytes](), False
    for view in sorted(masks.encoded):
        before = masks.get(*view)
        after = change(*view, before)
        changed[view] = encode(after)
        differ = differ or not np.array_equal(before, after)
    if not differ:
        raise NotApplicableError(f"{capture.name}: no mask would differ; its images are too small or too few for this")
    return Masks(changed, masks.report)


def _edge_distance_px(mask: np.ndarray) -> np.ndarray:
    """Return the distance of each pixel in a mask to the nearest one outside, (H, W); 0 outside."""
    return cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def _with_holes(mask: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    left, pixels = mask.astype(np.uint8), np.argwhere(mask)
    radius_px = max(1, round(HOLE_RADIUS * len(pixels) ** 0.5))
    while left.sum() > (1 - share) * len(pixels):
        y, x = pixels[rng.integers(len(pixels))]
        cv2.circle(left, (int(x), int(y)), radius_px, 0, cv2.FILLED)
    return left.astype(bool)


def _limb(person: np.ndarray, limb: tuple[int, int], shape: tuple[int, ...]) -> np.ndarray:
    """Return the pixels around a limb's bone and beyond its end, (H, W) bool, from a person's keypoints (25, 3); none
    if the limb was not detected."""
    covered = np.zeros(shape, np.uint8)
    start, end = person[limb[0]], person[limb[1]]
    if start[2] > 0 and end[2] > 0:
        along_px = end[:2] - start[:2]
        thickness_px = max(1, round(THICKNESS * float(np.linalg.norm(along_px))))
        ends = start[:2], end[:2] + BEYOND * along_px
        cv2.polylines(covered, [np.round(ends).astype(np.int32)], False, 1, thickness_px)
    return covered.astype(bool)

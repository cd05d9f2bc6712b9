"""The background behind the person in each camera: its clean plate, or what people leave uncovered at times."""

from dataclasses import dataclass

import cv2
import numpy as np

from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.evenly_spaced import evenly_spaced
from hnerf.segmentation.difference import masked_median

FRAMES = 60  # at most, evenly spaced, of which the background is the median
BESIDE_PX = 5  # around a mask, where a pixel may show the person or a contact shadow
MOSTLY = 0.5  # share of the outlines that must lie on known background


@dataclass(frozen=True)
class Plate:
    """The background of a camera: colour (H, W, 3) uint8 RGB; known (H, W) bool: where it was seen, not guessed."""

    colour: np.ndarray
    known: np.ndarray


def plates_of(capture: Capture, masks: Masks, frames: tuple[int, ...]) -> list[Plate] | None:
    """Return the plates of the training cameras: clean ones if there are any, otherwise the background that masks leave
    uncovered. None if, in some camera, the person hides the background behind most of their own outline in all
    frames."""
    plates = []
    for name in capture.train_cameras:
        clean = capture.background(name)
        plate = (
            _estimated(capture, masks, name, frames) if clean is None else Plate(clean, np.ones(clean.shape[:2], bool))
        )
        if plate is None:
            return None
        plates.append(plate)
    return plates


def _estimated(capture: Capture, masks: Masks, camera: str, frames: tuple[int, ...]) -> Plate | None:
    shown = evenly_spaced([frame for frame in frames if (camera, frame) in masks], FRAMES)
    if not shown:
        return None
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * BESIDE_PX + 1,) * 2)
    silhouettes = [masks.get(camera, frame).astype(np.uint8) for frame in shown]
    hidden = [cv2.dilate(mask, disc) > 0 for mask in silhouettes]
    colour, known = masked_median([capture.image(camera, frame) for frame in shown], hidden)
    outlines = [cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0 for mask in silhouettes]
    seen = np.concatenate([known[outline] for outline in outlines])
    return Plate(colour, known) if len(seen) and seen.mean() >= MOSTLY else None

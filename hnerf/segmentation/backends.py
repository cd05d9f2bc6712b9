"""Four sources of masks: given, learned, difference from a clean plate or from a median over time."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from hnerf.capture.capture import Capture
from hnerf.errors import InputError
from hnerf.evenly_spaced import evenly_spaced
from hnerf.segmentation.cut import components_within, cut
from hnerf.segmentation.difference import difference, exposure_corrected, masked_median, noise_level, visible_background
from hnerf.segmentation.learned import Network
from hnerf.segmentation.prior import Prior, PriorOf, bounding_window

MEDIAN_FRAMES = 60  # evenly spaced frames at most, to estimate the background without a plate

MaskOf = Callable[[int, Prior], np.ndarray]
"""Makes one camera's mask (H, W) bool of a frame, given the frame's prior."""


class Backend(NamedTuple):
    """A source of masks for one camera. name: for the report; by_prior: whether masks follow the prior where the
    background is never seen."""

    name: str
    mask_of: MaskOf
    by_prior: bool = False


def choose_backend(capture: Capture, camera: str, prior_of: PriorOf, fitted: bool, network: Network | None) -> Backend:
    """Return the first possible source of masks: given masks, the user's network, a clean plate, then the background
    around a `fitted` body or a detected person.

    Raises InputError if none is possible.
    """
    if any(capture.given_mask(camera, frame) is not None for frame in capture.frames):
        return Backend("given", partial(given_mask, capture, camera))
    if network is not None:
        return Backend("learned model", partial(_learned_mask, capture, camera, network))
    name = "median around the fitted body" if fitted else "median around the detected person"
    by_prior = capture.background(camera) is None
    if not by_prior:
        name = "clean plate"
    elif not fitted and not capture.has_person_masks:
        raise InputError(
            f"{capture.name}: camera {camera} has neither masks nor a plate (background/{camera}.jpg); fit a body first"
        )
    return Backend(name, background_subtraction(capture, camera, prior_of, MEDIAN_FRAMES), by_prior)


def given_mask(capture: Capture, camera: str, frame: int, prior: Prior) -> np.ndarray:
    """Return the mask that came with the recording, reduced to the subject if the prior finds it there; empty if the
    subject is known to be outside the image. Raises InputError if it is missing."""
    mask = capture.given_mask(camera, frame)
    if mask is None:
        raise InputError(f"masks/{camera}/{frame:06d}.png: mask missing; give a mask for every frame or for none")
    subject = components_within(mask, prior.reach)
    inverted = prior.core.any() and not (subject & prior.core).any() and mask.mean() > 0.5  # and shows only a gap
    return subject if (subject.any() and not inverted) or prior.elsewhere else mask


def _learned_mask(capture: Capture, camera: str, network: Network, frame: int, prior: Prior) -> np.ndarray:
    """Return where the network's probability of a person is at least one half, within reach of the prior."""
    likely = network.probability(capture.image(camera, frame)) >= 0.5
    return components_within(likely & prior.reach, prior.reach)


def background_subtraction(capture: Capture, camera: str, prior_of: PriorOf, count: int) -> MaskOf:
    """Return masks from the difference to the clean plate, which is known everywhere, if there is one, else to the
    median over at most `count` frames of the pixels that their priors leave free."""
    plate = capture.background(camera)
    if plate is not None:
        return partial(_subtracted, capture, camera, plate, np.ones(plate.shape[:2], bool), False)
    chosen = evenly_spaced(range(len(capture.frames)), count)
    images = [capture.image(camera, capture.frames[i]) for i in chosen]
    plate, known = masked_median(images, [prior_of(i).near for i in chosen])
    return partial(_subtracted, capture, camera, plate, known, True)


def _subtracted(
    capture: Capture, camera: str, plate: np.ndarray, known: np.ndarray, is_median: bool, frame: int, prior: Prior
) -> np.ndarray:
    """Return the mask found by GrabCut in the window within reach of the prior. plate (H, W, 3) uint8 RGB, where it is
    `known`, (H, W) bool."""
    image, window = capture.image(camera, frame), bounding_window(prior.reach)
    mask = np.zeros(image.shape[:2], bool)
    if not prior.reach.any():
        return mask
    free = visible_background(prior, known)
    plate = exposure_corrected(plate, image, free)
    found = difference(image[window], plate[window], noise_level(image, plate, free), shadowed=is_median)
    mask[window] = cut(image[window], found, prior.cropped(window), known[window])
    return mask

"""Four sources of masks behind one interface: given, learned, difference from a clean plate or from a median over
time."""

from dataclasses import dataclass, field

import numpy as np

from hnerf.capture.capture import Capture
from hnerf.config import SegmentationSettings
from hnerf.errors import InputError
from hnerf.evenly_spaced import evenly_spaced
from hnerf.segmentation.cut import components_within, cut
from hnerf.segmentation.difference import difference, exposure_corrected, masked_median, noise_level, visible_background
from hnerf.segmentation.learned import Network
from hnerf.segmentation.prior import Prior, PriorOf, bounding_window

CLEAN_PLATE = "clean plate"
AROUND_BODY, AROUND_DETECTED = "median around the fitted body", "median around the detected person"
MEDIAN_FRAMES = 60  # evenly spaced frames at most, to estimate the background without a plate


@dataclass(frozen=True)
class Given:
    """Masks that came with the recording; other people in them are removed."""

    capture: Capture
    camera: str
    name: str = "given"

    def mask(self, frame: int, prior: Prior) -> np.ndarray:
        """Return the given mask, reduced to the subject if the prior finds it there; empty if the subject is known to
        be outside the image. Raises InputError if it is missing."""
        mask = self.capture.given_mask(self.camera, frame)
        if mask is None:
            raise InputError(
                f"masks/{self.camera}/{frame:06d}.png: mask missing; give a mask for every frame or for none"
            )
        subject = components_within(mask, prior.reach)
        inverted = prior.core.any() and not (subject & prior.core).any() and mask.mean() > 0.5  # and shows only a gap
        return subject if (subject.any() and not inverted) or prior.elsewhere else mask


@dataclass(frozen=True)
class Learned:
    """The probability map of a network, reduced to the subject."""

    capture: Capture
    camera: str
    network: Network
    name: str = "learned model"

    def mask(self, frame: int, prior: Prior) -> np.ndarray:
        """Return where the probability of a person is at least one half, within reach of the prior."""
        likely = self.network.probability(self.capture.image(self.camera, frame)) >= 0.5
        return components_within(likely & prior.reach, prior.reach)


@dataclass(frozen=True)
class BackgroundSubtraction:
    """Difference from a plate, (H, W, 3) uint8 RGB, where it is `known`, (H, W) bool; then GrabCut."""

    capture: Capture
    camera: str
    plate: np.ndarray = field(repr=False)
    known: np.ndarray = field(repr=False)
    settings: SegmentationSettings
    name: str

    @staticmethod
    def of(
        capture: Capture, camera: str, prior_of: PriorOf, count: int, around: str, settings: SegmentationSettings
    ) -> "BackgroundSubtraction":
        """Use the clean plate, which is known everywhere, if there is one, else the median over at most `count` frames
        of the pixels that their priors leave free."""
        plate = capture.background(camera)
        if plate is not None:
            return BackgroundSubtraction(capture, camera, plate, np.ones(plate.shape[:2], bool), settings, CLEAN_PLATE)
        chosen = evenly_spaced(range(len(capture.frames)), count)
        images = [capture.image(camera, capture.frames[i]) for i in chosen]
        plate, known = masked_median(images, [prior_of(i).near for i in chosen])
        return BackgroundSubtraction(capture, camera, plate, known, settings, around)

    def mask(self, frame: int, prior: Prior) -> np.ndarray:
        """Return the mask, found in the window within reach of the prior."""
        image, window = self.capture.image(self.camera, frame), bounding_window(prior.reach)
        mask = np.zeros(image.shape[:2], bool)
        if not prior.reach.any():
            return mask
        free = visible_background(prior, self.known)
        plate = exposure_corrected(self.plate, image, free)
        noise, is_median = noise_level(image, plate, free), self.name != CLEAN_PLATE
        found = difference(image[window], plate[window], noise, self.settings, shadowed=is_median)
        mask[window] = cut(image[window], found, prior.cropped(window), self.known[window])
        return mask


Backend = Given | Learned | BackgroundSubtraction  # a source of masks for one camera; `name` is for the report


def choose_backend(
    capture: Capture, camera: str, prior_of: PriorOf, fitted: bool, network: Network | None,
    settings: SegmentationSettings,
) -> Backend:  # fmt: skip
    """Return the first possible source of masks: given masks, the user's network, a clean plate, then the background
    around a `fitted` body or a detected person.

    Raises InputError if none is possible.
    """
    if any(capture.given_mask(camera, frame) is not None for frame in capture.frames):
        return Given(capture, camera)
    if network is not None:
        return Learned(capture, camera, network)
    if not fitted and not capture.has_person_masks and capture.background(camera) is None:
        raise InputError(
            f"{capture.name}: camera {camera} has neither masks nor a plate (background/{camera}.jpg); fit a body first"
        )
    around = AROUND_BODY if fitted else AROUND_DETECTED
    return BackgroundSubtraction.of(capture, camera, prior_of, MEDIAN_FRAMES, around, settings)

"""Four ways to a mask, behind one interface: given, learned, against a clean plate, against a median over time."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from hnerf.capture.capture import Capture
from hnerf.config import SegmentationSettings
from hnerf.errors import InputError
from hnerf.evenly_spaced import evenly_spaced
from hnerf.segmentation.cut import components_within, cut
from hnerf.segmentation.difference import difference, exposure_corrected, masked_median, noise_level, surroundings
from hnerf.segmentation.learned import Network
from hnerf.segmentation.prior import Prior, window_around

CLEAN_PLATE = "clean plate"
AROUND_BODY, AROUND_DETECTED = "median around the fitted body", "median around the detected person"
MEDIAN_FRAMES = 60  # evenly chosen, for the background without a plate


class Backend(Protocol):
    """Masks of one camera of a capture. `name` is for the report."""

    @property
    def name(self) -> str: ...

    def mask(self, frame: int, prior: Prior) -> np.ndarray:
        """(H, W) bool, True on the person whom the prior describes."""
        ...


@dataclass(frozen=True)
class Given:
    """Masks that came with the recording; other people in them go."""

    capture: Capture
    camera: str
    name: str = "given"

    def mask(self, frame: int, prior: Prior) -> np.ndarray:
        """The given mask, or what of it is the subject. Raises InputError where it is missing."""
        mask = self.capture.given_mask(self.camera, frame)
        if mask is None:
            raise InputError(
                f"masks/{self.camera}/{frame:06d}.png: mask missing; give a mask for every frame or for none"
            )
        subject = components_within(mask, prior.reach)
        return subject if subject.any() else mask


@dataclass(frozen=True)
class Learned:
    """A network's probability map, as far as it is the subject."""

    capture: Capture
    camera: str
    network: Network
    name: str = "learned model"

    def mask(self, frame: int, prior: Prior) -> np.ndarray:
        """Where the person is likelier than not, within reach."""
        likely = self.network.probability(self.capture.image(self.camera, frame)) >= 0.5
        return components_within(likely & prior.reach, prior.reach)


@dataclass(frozen=True)
class AgainstBackground:
    """Difference to a plate, (H, W, 3) uint8 RGB, where it is `known`, (H, W) bool; then GrabCut."""

    capture: Capture
    camera: str
    plate: np.ndarray = field(repr=False)
    known: np.ndarray = field(repr=False)
    settings: SegmentationSettings
    name: str

    @staticmethod
    def of_plate(
        capture: Capture, camera: str, plate: np.ndarray, settings: SegmentationSettings
    ) -> "AgainstBackground":
        """A clean plate is known everywhere."""
        return AgainstBackground(capture, camera, plate, np.ones(plate.shape[:2], bool), settings, CLEAN_PLATE)

    @staticmethod
    def of_median(
        capture: Capture, camera: str, priors: Sequence[Prior], count: int, settings: SegmentationSettings,
        name: str = AROUND_BODY,
    ) -> "AgainstBackground":  # fmt: skip
        """The background from at most `count` frames, where the priors, in the order of the frames, leave it free."""
        chosen = evenly_spaced(range(len(priors)), count)
        images = [capture.image(camera, capture.frames[i]) for i in chosen]
        plate, known = masked_median(images, [priors[i] for i in chosen])
        return AgainstBackground(capture, camera, plate, known, settings, name)

    def mask(self, frame: int, prior: Prior) -> np.ndarray:
        """Cut out of the window within reach."""
        image, window = self.capture.image(self.camera, frame), window_around(prior.reach)
        mask = np.zeros(image.shape[:2], bool)
        if not prior.reach.any():
            return mask
        free = surroundings(prior, self.known)
        plate = exposure_corrected(self.plate, image, free)
        noise, is_median = noise_level(image, plate, free), self.name != CLEAN_PLATE
        found = difference(image[window], plate[window], noise, self.settings, shadowed=is_median)
        mask[window] = cut(image[window], found, prior.cropped(window), self.known[window])
        return mask


def choose_backend(
    capture: Capture, camera: str, priors: list[Prior], fitted: bool, network: Network | None,
    settings: SegmentationSettings,
) -> Backend:  # fmt: skip
    """Given masks first, then the user's network, then a clean plate, then the background around a
    `fitted` body or a detected person.

    priors: in the order of the capture's frames. Raises InputError where none is possible.
    """
    if any(capture.given_mask(camera, frame) is not None for frame in capture.frames):
        return Given(capture, camera)
    if network is not None:
        return Learned(capture, camera, network)
    plate = capture.background(camera)
    if plate is not None:
        return AgainstBackground.of_plate(capture, camera, plate, settings)
    if not fitted and not capture.was_looked_at:
        raise InputError(
            f"{capture.name}: camera {camera} has neither masks nor a plate (background/{camera}.jpg); fit a body first"
        )
    around = AROUND_BODY if fitted else AROUND_DETECTED
    return AgainstBackground.of_median(capture, camera, priors, MEDIAN_FRAMES, settings, around)

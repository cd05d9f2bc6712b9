"""Masks of the person in every training view: given, from clean plates, or else around a fitted body."""

import logging
from collections.abc import Iterator
from typing import Any

import numpy as np

from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.config import SegmentationSettings
from hnerf.errors import CaptureError
from hnerf.segmentation.cut import components_within, cut
from hnerf.segmentation.difference import difference, masked_median, noise_level
from hnerf.segmentation.masks import Masks, encode
from hnerf.segmentation.prior import Prior, body_priors, keypoint_priors, window_around

__all__ = ["Masks", "segment"]

LEAST_AREA_SHARE = 0.1  # of the prior's core: less is no person
JUMP = 1.3  # areas of neighbouring frames that differ by more are reported
MEDIAN_FRAMES = 60  # evenly chosen, for the background without a plate

log = logging.getLogger("hnerf.segmentation")


def segment(capture: Capture, body: BodyFit | None, settings: SegmentationSettings) -> Masks:
    """Masks for all training cameras and `capture.frames`.

    A camera with given masks keeps them; with a clean plate it is compared to that; else it needs `body`, to find the
    background from pixels that the body does not reach. Only the subject is kept where there are several people.
    Raises CaptureError, naming the image, on an empty or an inverted mask.
    """
    priors = keypoint_priors(capture, settings) if body is None else body_priors(capture, body, settings)
    encoded: dict[tuple[str, int], bytes] = {}
    cameras: dict[str, Any] = {}
    for name in capture.train_cameras:
        backend = _backend(capture, name, body)
        log.info("camera %s: %d masks, %s", name, len(capture.frames), backend)
        areas, notes = [], []
        for frame, prior, mask in zip(
            capture.frames, priors[name], _masks(capture, name, backend, priors[name], settings), strict=True
        ):
            _check(capture, name, frame, mask, prior)
            encoded[name, frame] = encode(mask)
            areas.append(int(mask.sum()))
            if mask[[0, -1]].any() or mask[:, [0, -1]].any():
                notes.append(f"frame {frame}: the person is cut off by the image's border")
        cameras[name] = {
            "backend": backend,
            "median_area_px": int(np.median(areas)),
            "notes": notes + _jumps(capture.frames, areas),
        }
    return Masks(encoded, {"cameras": cameras})


def _backend(capture: Capture, name: str, body: BodyFit | None) -> str:
    given = [capture.given_mask(name, frame) is not None for frame in capture.frames]
    if all(given):
        return "given"
    if any(given):
        frame = capture.frames[given.index(False)]
        raise CaptureError(f"masks/{name}/{frame:06d}.png: mask missing; give a mask for every frame or for none")
    if capture.background(name) is not None:
        return "clean plate"
    if body is None:
        raise CaptureError(
            f"{capture.name}: camera {name} has neither masks nor a plate (background/{name}.jpg); fit a body first"
        )
    return "median around the fitted body"


def _masks(
    capture: Capture, name: str, backend: str, priors: list[Prior], settings: SegmentationSettings
) -> Iterator[np.ndarray]:
    """(H, W) bool for each of the capture's frames."""
    if backend == "given":
        for frame, prior in zip(capture.frames, priors, strict=True):
            mask = capture.given_mask(name, frame)
            assert mask is not None  # _backend looked
            subject = components_within(mask, prior.reach)
            yield subject if subject.any() else mask
        return
    plate = capture.background(name)
    known = np.ones(capture.image(name, capture.frames[0]).shape[:2], bool)
    if plate is None:
        chosen = np.unique(np.linspace(0, len(priors) - 1, MEDIAN_FRAMES).round().astype(int))
        images = [capture.image(name, capture.frames[i]) for i in chosen]
        plate, known = masked_median(images, [priors[i] for i in chosen])
    for frame, prior in zip(capture.frames, priors, strict=True):
        image, window = capture.image(name, frame), window_around(prior.reach)
        found = difference(image[window], plate[window], noise_level(image, plate), settings)
        mask = np.zeros(image.shape[:2], bool)
        mask[window] = cut(image[window], found, prior.cropped(window), known[window])
        yield mask


def _check(capture: Capture, name: str, frame: int, mask: np.ndarray, prior: Prior) -> None:
    """CaptureError on a mask that misses the person whom keypoints or body show in this image."""
    expected = int(prior.core.sum())
    if expected == 0:
        return
    where = f"{capture.name}: camera {name}, frame {frame}"
    if mask.sum() < LEAST_AREA_SHARE * expected:
        raise CaptureError(f"{where}: no person in the mask; check the clean plate or the given mask of this image")
    if mask[prior.core].mean() < 0.5 < mask.mean():
        raise CaptureError(f"{where}: the mask is inverted (255 must be on the person); invert the masks")


def _jumps(frames: tuple[int, ...], areas_px: list[int]) -> list[str]:
    notes = []
    for i in range(1, len(areas_px)):
        low, high = sorted(areas_px[i - 1 : i + 1])
        if frames[i] == frames[i - 1] + 1 and high > JUMP * low:
            notes.append(f"frame {frames[i]}: area jumps from {areas_px[i - 1]} to {areas_px[i]} px")
    return notes

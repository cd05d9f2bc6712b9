"""Masks of the person in every training view: given, from a network, from clean plates, or else around a fitted
body."""

import dataclasses
import logging
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks, encode
from hnerf.capture.subject import subject_keypoints
from hnerf.config import SegmentationSettings
from hnerf.errors import InputError
from hnerf.progress import tracked
from hnerf.segmentation.backends import Backend, choose_backend
from hnerf.segmentation.learned import Network
from hnerf.segmentation.prior import PriorOf, camera_priors
from hnerf.segmentation.verdicts import MaskVerdict, area_jumps, judge_mask
from hnerf.side_by_side import side_by_side

log = logging.getLogger("hnerf.segmentation")


def segment(capture: Capture, body: BodyFit | None, settings: SegmentationSettings) -> Masks:
    """Return masks for all training cameras and `capture.frames`.

    A camera with given masks keeps them; the user's network comes next, then a clean plate. Otherwise the background is
    estimated from pixels out of reach of `body` or of the detected person. Of several people, only the subject is kept.
    A mask that cannot be right, or that only the interpolated pose of an absent subject explains, is dropped and listed
    in the report. Raises InputError if no mask of a camera is left.
    """
    priors = camera_priors(capture, body, settings)
    network = None if settings.model is None else Network(settings.model)
    encoded: dict[tuple[str, int], bytes] = {}
    cameras: dict[str, Any] = {}
    absent = _frames_without_subject(capture)
    for name, prior_of in tracked(priors, "segmentation", len(capture.train_cameras)):
        backend = choose_backend(capture, name, prior_of, body is not None, network)
        log.info("camera %s: %d masks, %s", name, len(capture.frames), backend.name)
        judged = partial(_judged_mask, capture, backend, prior_of, absent)
        masks = list(side_by_side(judged, range(len(capture.frames))))
        cameras[name] = {"backend": backend.name} | _findings(capture, name, masks)
        encoded |= {(name, frame): mask.encoded for frame, mask in zip(capture.frames, masks, strict=True)}
        for row in cameras[name]["dropped"]:
            del encoded[name, row["frame"]]
    return Masks(encoded, {"cameras": cameras})


class _JudgedMask(NamedTuple):
    """The mask of one image, encoded, with its verdict and the number of pixels of the prior's body."""

    encoded: bytes
    verdict: MaskVerdict
    body_px: int


def _frames_without_subject(capture: Capture) -> frozenset[int]:
    """Return the frames in which no training camera detects the subject, and for which no pose is given; none if the
    recording has no keypoints."""
    if not capture.has_keypoints:
        return frozenset()
    found = np.stack(list(subject_keypoints(capture).values()))
    known = (found[..., 2] > 0).any((0, 2))
    if poses := capture.given_poses():
        known = known | poses.known
    return frozenset(capture.frames[i] for i in np.flatnonzero(~known))


def _judged_mask(
    capture: Capture, backend: Backend, prior_of: PriorOf, absent: frozenset[int], number: int
) -> _JudgedMask:
    prior, frame = prior_of(number), capture.frames[number]
    if backend.by_prior and frame in absent:  # the prior is only interpolated
        nothing = np.zeros_like(prior.body)
        return _JudgedMask(encode(nothing), MaskVerdict("nobody is detected in this frame", None, 0), 0)
    mask = backend.mask_of(frame, prior)
    return _JudgedMask(encode(mask), judge_mask(mask, prior), int(prior.body.sum()))


def _findings(capture: Capture, camera: str, masks: list[_JudgedMask]) -> dict[str, Any]:
    """Return plain values: the median area, and the frames that are dropped or noted, each with its reason."""
    sudden = area_jumps(capture.frames, [mask.verdict for mask in masks], [mask.body_px for mask in masks])
    judged = {
        frame: dataclasses.replace(mask.verdict, fault=mask.verdict.fault or sudden.get(frame))
        for frame, mask in zip(capture.frames, masks, strict=True)
    }
    dropped = [{"frame": frame, "reason": v.fault} for frame, v in judged.items() if v.fault]
    if len(dropped) == len(judged):
        raise InputError(
            f"{capture.name}: camera {camera}: no mask is usable (frame {dropped[0]['frame']}: "
            f"{dropped[0]['reason']}); check its clean plate, its given masks and its calibration, or leave it out"
        )
    for row in dropped:
        log.warning("camera %s, frame %d: mask dropped: %s", camera, row["frame"], row["reason"])
    return {
        "median_area_px": int(np.median([v.area_px for v in judged.values() if not v.fault])),
        "dropped": dropped,
        "notes": [{"frame": frame, "note": v.note} for frame, v in judged.items() if v.note and not v.fault],
    }

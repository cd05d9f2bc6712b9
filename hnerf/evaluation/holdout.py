"""Figures of captures without test cameras: fields that were trained without a camera, against what it photographed."""

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from hnerf.avatar.avatar import Avatar
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.config import EvaluationSettings
from hnerf.errors import InputError
from hnerf.evaluation.columns import shown_as, why_not_shown
from hnerf.evaluation.images import mean_of, render, score_split, scored_views, unscored
from hnerf.evaluation.views import PRIMARY

EACH = "each"
LEAST_CAMERAS = 2  # left to train on
SCORES = "holdout.json"
FIGURES = ("psnr", "ssim", "mask_iou", "lpips")
LABEL = "photographs under the capture's own masks, camera left out of fit and training"
NOT_ASKED = "no field was trained without a camera, as `hnerf run --set evaluation.holdout=each` does, for each in turn"


@dataclass(frozen=True)
class OwnMasks:
    """The Truth of captures without one: the person under the masks that segmentation made."""

    capture: Capture
    masks: Masks
    has_masks: ClassVar[bool] = True

    def has_mask(self, camera: str, frame: int) -> bool:
        """Whether this image has a mask that can be trusted."""
        return (camera, frame) in self.masks

    def mask(self, camera: str, frame: int) -> np.ndarray:
        """(H, W) bool, True on the person."""
        return self.masks.get(camera, frame)

    def on_black(self, camera: str, frame: int) -> tuple[np.ndarray, str]:
        """The photograph under its mask, (H, W, 3) uint8, and these words."""
        return self.capture.image(camera, frame) * self.mask(camera, frame)[..., None], "photograph x own mask"


def cameras_left_out(train: Sequence[str], test: Sequence[str], holdout: str | None) -> tuple[str, ...]:
    """The training cameras that `evaluation.holdout` names; none where test cameras score the capture.

    InputError, one line, for one that is not there, or where fewer than LEAST_CAMERAS would be left.
    """
    if holdout is None or test:
        return ()
    if holdout != EACH and holdout not in train:
        raise InputError(f"evaluation.holdout={holdout}: no such training camera; there are {', '.join(train)}")
    if len(train) <= LEAST_CAMERAS:
        raise InputError(
            f"evaluation.holdout={holdout}: of {len(train)} training cameras fewer than {LEAST_CAMERAS} would be left; "
            "take the setting out"
        )
    return tuple(train) if holdout == EACH else (holdout,)


def score_held_out(
    capture: Capture,
    masks: Masks,
    avatar: Avatar,
    fitted: BodyFit,
    training: Path,
    settings: EvaluationSettings,
    out: Path,
) -> dict[str, Any]:
    """Write `holdout.json`, figures of the camera `settings.holdout`, and `renders/` into `out`; what the former holds.

    capture, masks: with that camera; avatar, fitted, training: the field, the body and the folder that were made
    without it.
    """
    camera = settings.holdout
    assert camera is not None
    others = tuple(name for name in capture.train_cameras if name != camera)
    seen = dataclasses.replace(capture, train_cameras=others, test_cameras=(camera,))
    truth = OwnMasks(seen, masks)
    found: dict[str, Any] = {"camera": camera, "trained_on": others}
    for split in PRIMARY:
        why = why_not_shown(split, training)
        views = [] if why else scored_views(seen, split, truth, settings.max_images)
        if views:
            render({split: shown_as(split, avatar, fitted)}, seen, views, out)
        found[split] = unscored(why) if why else score_split(seen, split, views, truth, out)
    (out / SCORES).write_text(json.dumps(found, indent=1))
    return found


def gathered(capture: Capture, folders: Sequence[Path]) -> dict[str, Any]:
    """What metrics.json says of the folders that `score_held_out` filled: figures by camera, and their mean over the
    cameras that have any; null with a reason where there are no folders."""
    if not folders:
        reason = "the capture has test cameras, which score it" if capture.test_cameras else NOT_ASKED
        return {"holdout": None, "holdout_reason": reason}
    cameras = {found.pop("camera"): found for found in (json.loads((f / SCORES).read_text()) for f in folders)}
    mean = {split: {key: mean_of([c[split][key] for c in cameras.values()]) for key in FIGURES} for split in PRIMARY}
    return {"holdout": {"what": LABEL, "cameras": cameras, "mean": mean}}

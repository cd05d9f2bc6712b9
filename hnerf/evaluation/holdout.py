"""Scores of captures without test cameras: fields trained without one camera, compared with that camera's
photographs."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hnerf.avatar.avatar import Avatar
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.config import EvaluationSettings
from hnerf.errors import InputError
from hnerf.evaluation.columns import avatar_for_split, reason_unavailable
from hnerf.evaluation.ground_truth import OwnMasks
from hnerf.evaluation.images import MEANS, mean_of, render, score_split, scored_views, unscored
from hnerf.evaluation.report import FIGURES
from hnerf.evaluation.views import PRIMARY_SPLITS
from hnerf.results.files import write_result
from hnerf.results.scores import HeldOutCamera

EACH = "each"
MIN_CAMERAS = 2  # that must remain for training
SCORES_FILE = "holdout.json"
LABEL = "photographs under the capture's own masks, camera left out of fit and training"
NOT_REQUESTED = (
    "no field was trained without a camera; `hnerf run --set evaluation.holdout=each` trains one without each in turn"
)


def held_out_cameras(train: Sequence[str], test: Sequence[str], holdout: str | None) -> tuple[str, ...]:
    """Return the training cameras that `evaluation.holdout` names; none if test cameras score the capture.

    Raises InputError, one line, if there is no such camera or fewer than MIN_CAMERAS would be left.
    """
    if holdout not in (None, EACH, *train):
        raise InputError(f"evaluation.holdout={holdout}: no such training camera; there are {', '.join(train)}")
    if holdout is None or test:
        return ()
    if len(train) <= MIN_CAMERAS:
        raise InputError(
            f"evaluation.holdout={holdout}: fewer than {MIN_CAMERAS} of the {len(train)} training cameras would be "
            "left; remove the setting"
        )
    return tuple(train) if holdout == EACH else (holdout,)


def score_held_out(
    capture: Capture,
    masks: Masks,
    avatar: Avatar,
    fitted: BodyFit,
    training: Path,
    camera: str,
    settings: EvaluationSettings,
    out: Path,
) -> HeldOutCamera:
    """Write `holdout.json`, the scores of a camera, and `renders/` into `out`; return what holdout.json holds.

    capture, masks: with that camera; avatar, fitted, training: the field, the body and the training folder that were
    made without it.
    """
    others = tuple(name for name in capture.train_cameras if name != camera)
    seen = dataclasses.replace(capture, train_cameras=others, test_cameras=(camera,))
    truth = OwnMasks(seen, masks)
    found: Any = {"camera": camera, "trained_on": list(others)}
    for split in PRIMARY_SPLITS:
        why = reason_unavailable(split, training)
        views = [] if why else scored_views(split, truth, settings.max_images)
        if views:
            render({split: avatar_for_split(split, avatar, fitted)}, seen, views, out)
        found[split] = unscored(why) if why else score_split(split, views, truth, out)
    write_result(out / SCORES_FILE, HeldOutCamera, found)
    return found


def collect_held_out(capture: Capture, folders: Sequence[Path]) -> dict[str, Any]:
    """Return metrics.json's entries for the folders that `score_held_out` filled: scores by camera, and their mean over
    the cameras that have any; null with a reason if there are no folders."""
    if not folders:
        reason = "the capture has test cameras, which score it" if capture.test_cameras else NOT_REQUESTED
        return {"holdout": None, "holdout_reason": reason}
    cameras = {found.pop("camera"): found for found in (json.loads((f / SCORES_FILE).read_text()) for f in folders)}
    keys = [key for key, *_ in FIGURES if key in MEANS]
    mean = {split: {k: mean_of([c[split][k] for c in cameras.values()]) for k in keys} for split in PRIMARY_SPLITS}
    return {"holdout": {"what": LABEL, "cameras": cameras, "mean": mean}}

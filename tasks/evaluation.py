"""The evaluation stage: the avatar's quality and what it cost."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hnerf.avatar.trained import load_avatar
from hnerf.body.fit_result import BodyFit
from hnerf.capture.masks import Masks
from hnerf.config import EvaluationSettings
from hnerf.evaluation.evaluate import evaluate as evaluate_avatar
from hnerf.evaluation.holdout import score_held_out
from hnerf.evaluation.inputs import EvaluationInputs
from hnerf.evaluation.views import SPLITS
from hnerf.models import LPIPS_ALEXNET
from tasks.calibration import calibrated_capture
from tasks.source import Source, require_unchanged
from tasks.stage import stage
from tasks.store import Artifact


@stage("evaluation", version="23", networks=(LPIPS_ALEXNET,))
def evaluate(
    out: Path,
    truth: Source,
    recording: Artifact,
    calibration: Artifact,
    segmentation: Artifact,
    body: Artifact,
    training: Artifact,
    settings: EvaluationSettings,
    held_out: tuple[Artifact, ...] = (),
) -> dict[str, float]:
    """Write renderings, meshes and scores according to the evaluation protocol of docs/method.md, and a report.
    held_out: artifacts of `evaluate_held_out`, one per camera."""
    inputs = EvaluationInputs(
        capture_folder=truth.root,
        capture=calibrated_capture(recording, calibration),
        masks=Masks.load(segmentation.root),
        fitted=BodyFit.load(body.root),
        avatar=load_avatar(training.root),
        calibration_folder=calibration.root,
        segmentation_folder=segmentation.root,
        fit_folder=body.root,
        fit_seconds=body.metrics,
        training_folder=training.root,
        held_out_folders=tuple(scores.root for scores in held_out),
    )
    found = evaluate_avatar(inputs, settings, out)
    require_unchanged(truth)
    held_out_mean = _headline((found["holdout"] or {"mean": {}})["mean"])
    return _headline(found) | {f"holdout {name}": value for name, value in held_out_mean.items()}


@stage("holdout", version="7", networks=(LPIPS_ALEXNET,))
def evaluate_held_out(
    out: Path,
    recording: Artifact,
    calibration: Artifact,
    segmentation: Artifact,
    body: Artifact,
    training: Artifact,
    camera: str,
    settings: EvaluationSettings,
) -> dict[str, float]:
    """Score an avatar on a camera, under its own masks. Recording, calibration and segmentation include that camera;
    body and training were made without it."""
    capture, masks = calibrated_capture(recording, calibration), Masks.load(segmentation.root)
    avatar, fitted = load_avatar(training.root), BodyFit.load(body.root)
    return _headline(score_held_out(capture, masks, avatar, fitted, training.root, camera, settings, out))


def _headline(found: Mapping[Any, Any]) -> dict[str, float]:
    """Return the mean image scores of each split that has any."""
    return {
        f"{split} {name}": value
        for split in SPLITS
        if split in found
        for name in ("psnr", "ssim", "lpips")
        if (value := found[split][name]) is not None
    }

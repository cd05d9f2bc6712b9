"""Stage 6: how good it is, and what it cost."""

import itertools
from pathlib import Path
from typing import Any

from hnerf.body.fit_result import BodyFit
from hnerf.config import EvaluationSettings
from hnerf.evaluation.evaluate import evaluate as evaluate_avatar
from hnerf.evaluation.inputs import EvaluationInputs
from hnerf.segmentation.masks import Masks
from tasks.calibration import calibrated
from tasks.source import Source
from tasks.stage import stage
from tasks.store import Artifact
from tasks.training import trained


@stage("evaluation", version="9")
def evaluate(
    out: Path,
    truth: Source,
    recording: Artifact,
    calibration: Artifact,
    segmentation: Artifact,
    body: Artifact,
    training: Artifact,
    settings: EvaluationSettings,
) -> dict[str, float]:
    """Renderings, meshes and figures by the evaluation protocol of docs/method.md, and a report for people."""
    inputs = EvaluationInputs(
        capture_folder=truth.root,
        capture=calibrated(recording, calibration),
        masks=Masks.load(segmentation.root),
        fitted=BodyFit.load(body.root),
        avatar=trained(training),
        calibration_folder=calibration.root,
        segmentation_folder=segmentation.root,
        fit_folder=body.root,
        fit_seconds=body.metrics,
        training_folder=training.root,
    )
    return _headline(evaluate_avatar(inputs, settings, out))


def _headline(found: dict[str, Any]) -> dict[str, float]:
    """The mean image figures of both splits, those that there are."""
    wanted = itertools.product(("novel_view", "novel_pose"), ("psnr", "ssim"))
    return {f"{split} {name}": found[split][name] for split, name in wanted if found[split][name] is not None}

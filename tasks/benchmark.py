"""The scoring stages of a benchmark: scores of a training's snapshots and its final model, and rendering times."""

from pathlib import Path

from hnerf.body.fit_result import BodyFit
from hnerf.evaluation.ground_truth import truth_of
from hnerf.models import LPIPS_ALEXNET
from hnerf.study.benchmark.plan import ScoringSettings
from hnerf.study.benchmark.scoring import ScoringScene, score, score_end
from tasks.calibration import calibrated_capture
from tasks.source import Source, require_unchanged
from tasks.stage import stage
from tasks.store import Artifact


@stage("scoring", version="18", networks=(LPIPS_ALEXNET,))
def score_training(
    out: Path,
    truth: Source,
    recording: Artifact,
    calibration: Artifact,
    body: Artifact,
    training: Artifact,
    settings: ScoringSettings,
) -> dict[str, float]:
    """Score a training's snapshots and its final model on held-out data, and time the rendering of a frame."""
    found = score(scoring_scene(truth, recording, calibration, body), training.root, settings, out)
    require_unchanged(truth)
    psnr = found[found["split"]]["psnr"]
    return {} if psnr is None else {"psnr": psnr}


@stage("scoring-end", version="8", networks=(LPIPS_ALEXNET,))
def score_end_of_training(
    out: Path,
    truth: Source,
    recording: Artifact,
    calibration: Artifact,
    body: Artifact,
    training: Artifact,
    settings: ScoringSettings,
) -> dict[str, float]:
    """Score only the last point of a training's curve."""
    found = score_end(scoring_scene(truth, recording, calibration, body), training.root, settings, out)
    require_unchanged(truth)
    return {"steps": found["training"]["steps"], "seconds": found["training"]["field_seconds"]}


def scoring_scene(truth: Source, recording: Artifact, calibration: Artifact, body: Artifact) -> ScoringScene:
    """Return what trainings on a recording are scored against."""
    capture = calibrated_capture(recording, calibration)
    return ScoringScene(capture, BodyFit.load(body.root), truth_of(truth.root, capture))

"""The references of a benchmark's scoring stages, on a ball."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from hnerf.evaluation.evaluate import PROTOCOL
from hnerf.evaluation.ground_truth import GIVEN_MASKED_IMAGE
from hnerf.study.benchmark import scoring
from hnerf.study.benchmark.plan import ScoringSettings
from tasks import benchmark as module
from tasks.source import read_capture
from tasks.store import Artifact
from tests.evaluation.ball import BallAvatar, ball_fit, write_ball_capture, write_ball_masks, write_settings


def test_test_cameras_without_true_masks_are_scored_with_the_recordings_masks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = write_ball_capture(tmp_path / "capture")
    write_ball_masks(capture, "c")
    training = tmp_path / "training"
    training.mkdir()
    write_settings(training)
    (training / "report.json").write_text(json.dumps({"field_seconds": 12.0}))
    monkeypatch.setattr(module, "calibrated_capture", lambda *_: capture)
    monkeypatch.setattr(module, "BodyFit", SimpleNamespace(load=lambda _: ball_fit()))
    monkeypatch.setattr(scoring, "load_avatar", lambda *_: BallAvatar(ball_fit()))
    monkeypatch.setattr(scoring, "write_result", lambda *_: None)  # it would require a complete training report
    artifact = Artifact(stage="any", root=tmp_path, files={})
    scene = module.scoring_scene(read_capture(capture.root)[1], artifact, artifact, artifact)
    settings = ScoringSettings(meshes=1, snapshot_images=1, snapshot_meshes=0, frame_sizes_px=(16,))
    found = scoring.score(scene, training, settings, tmp_path)
    assert found["novel_view"]["reference"] == found["curve"][0]["reference"] == GIVEN_MASKED_IMAGE
    assert found["protocol"].startswith(f"{PROTOCOL} Here, images are compared to photographs under the masks")

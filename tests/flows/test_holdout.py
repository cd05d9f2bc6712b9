"""Fields trained with one camera held out: the inputs of their fit and training, and their scores."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from flows import preparation
from flows import train_subject as module
from flows.cli import main
from flows.train_subject import train_subject
from hnerf.capture.capture import Capture
from hnerf.capture.formats.easymocap import write_easymocap
from hnerf.capture.lens import pinhole
from hnerf.config import load_settings
from tasks.calibration import calibrated_capture
from tasks.store import Artifact
from tests.flows.test_train_subject import STAGES, replace_stages
from tests.study.recording import ROTATIONS, write_recording

CAMERAS = tuple(ROTATIONS)  # 01, 02, 03
HELD_OUT = ["evaluation.holdout=each"]


def write_three(out: Path) -> None:
    """Write the recording of tests/study/recording.py, with all of its cameras for training."""
    dataclasses.replace(write_recording(out), train_cameras=CAMERAS, test_cameras=()).save()


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Return the list of stage calls that did work: name and inputs of each. Only the stage that removes cameras is
    real."""
    made: list[dict[str, Any]] = []

    def write(stage: str, out: Path, **inputs: Any) -> dict[str, float]:
        made.append({"stage": stage} | inputs)
        if stage == "capture":
            write_three(out)
        elif stage == "calibration":
            cameras = Capture.load(inputs["recording"].root).cameras
            write_easymocap(out, [pinhole(camera) for camera in cameras.values()])
            (out / "report.json").write_text(json.dumps({"cameras": {n: {"frame_offset": 0.0} for n in cameras}}))
        else:
            (out / "made").write_text(str(len(made)))
        settings = {"static": False, "training": load_settings("fast").training.model_dump()}
        (out / "settings.json").write_text(json.dumps(settings))
        return {}

    replace_stages(monkeypatch, (*STAGES, "evaluate_held_out"), write)
    monkeypatch.setattr(preparation, "needs_body", lambda *_: True)
    monkeypatch.setattr(preparation, "needs_detection", lambda *_: False)
    monkeypatch.setattr(preparation, "needs_hands", lambda *_: False)
    monkeypatch.setattr(preparation, "converged", lambda *_: True)
    (tmp_path / "ada").mkdir()
    whole = write_recording(tmp_path / "whole")
    write_easymocap(tmp_path / "ada", [pinhole(camera) for camera in whole.cameras.values()])
    (tmp_path / "ada" / "images").mkdir()
    return made


def of_stage(calls: list[dict[str, Any]], stage: str) -> list[dict[str, Any]]:
    return [call for call in calls if call["stage"] == stage]


def test_a_held_out_camera_never_reaches_fit_masks_or_training(calls: list[dict[str, Any]], tmp_path: Path) -> None:
    train_subject.fn(tmp_path / "ada", "demo", tmp_path / "store", ["evaluation.holdout='02'"])
    for stage, times in (("segmentation", 2), ("fit", 4), ("training", 2)):  # once with all cameras, once without
        assert len(of_stage(calls, stage)) == times
        without_camera = [call for call in of_stage(calls, stage) if call["recording"].stage == "subset"]
        assert len(without_camera) == times // 2
        for call in without_camera:
            assert calibrated_capture(call["recording"], call["calibration"]).train_cameras == ("01", "03")
            root = call["recording"].root
            assert not [path for path in root.rglob("*") if "02" in path.relative_to(root).parts or path.stem == "02"]
            assert Capture.load(root).keypoints("02") is None
    whole, left = of_stage(calls, "training")
    assert whole["recording"].stage == "capture"
    assert {left[name].root for name in ("segmentation", "body")}.isdisjoint(
        whole[name].root for name in ("segmentation", "body")
    )


def test_a_held_out_camera_is_scored_with_the_masks_of_the_full_run(
    calls: list[dict[str, Any]], tmp_path: Path
) -> None:
    train_subject.fn(tmp_path / "ada", "demo", tmp_path / "store", ["evaluation.holdout='02'"])
    (scored,), (whole, left) = of_stage(calls, "holdout"), of_stage(calls, "training")
    assert scored["camera"] == "02"
    assert scored["recording"].stage == "capture" and scored["segmentation"] == whole["segmentation"]
    assert scored["body"] == left["body"] and scored["body"] != whole["body"]
    (report,) = of_stage(calls, "evaluation")
    assert [artifact.stage for artifact in report["held_out"]] == ["holdout"]


def test_each_camera_is_held_out_once_and_its_results_are_reused(calls: list[dict[str, Any]], tmp_path: Path) -> None:
    train_subject.fn(tmp_path / "ada", "demo", tmp_path / "store", HELD_OUT)
    assert [call["camera"] for call in of_stage(calls, "holdout")] == list(CAMERAS)
    assert len(of_stage(calls, "training")) == 4
    done = len(calls)
    train_subject.fn(tmp_path / "ada", "demo", tmp_path / "store", HELD_OUT)
    assert len(calls) == done
    train_subject.fn(tmp_path / "ada", "demo", tmp_path / "store", ["evaluation.holdout='02'"])
    assert [call["stage"] for call in calls[done:]] == ["evaluation"]  # all others are reused


def test_without_the_setting_no_camera_is_held_out(calls: list[dict[str, Any]], tmp_path: Path) -> None:
    train_subject.fn(tmp_path / "ada", "demo", tmp_path / "store", [])
    assert len(of_stage(calls, "training")) == 1 and of_stage(calls, "holdout") == []
    assert of_stage(calls, "evaluation")[0]["held_out"] == ()


@pytest.mark.parametrize(
    ("holdout", "train", "message"),
    [
        ("cam9", CAMERAS, "evaluation.holdout=cam9: no such training camera; there are 01, 02, 03"),
        ("each", CAMERAS[:2], "fewer than 2 of the 2 training cameras would be left"),
    ],
)
def test_an_impossible_holdout_is_refused_right_after_ingestion(
    calls: list[dict[str, Any]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    holdout: str,
    train: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.setattr(sys.modules[__name__], "CAMERAS", train)
    options = ["--store", str(tmp_path / "store"), "--set", f"evaluation.holdout={holdout}"]
    assert main(["run", str(tmp_path / "ada"), *options]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert [call["stage"] for call in calls] == ["capture"]


def test_cameras_that_calibration_rejects_do_not_count_for_the_holdout(
    calls: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_03(recording: Artifact, calibration: Artifact) -> Capture:
        return dataclasses.replace(calibrated_capture(recording, calibration), train_cameras=("01", "02"))

    monkeypatch.setattr(module, "calibrated_capture", without_03)
    assert main(["run", str(tmp_path / "ada"), "--store", str(tmp_path / "store"), "--set", HELD_OUT[0]]) == 2
    assert "fewer than 2 of the 2 training cameras" in capsys.readouterr().err
    assert of_stage(calls, "fit") == []

"""Held-out cameras, on a ball seen by three of them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks, encode
from hnerf.config import EvaluationSettings
from hnerf.errors import InputError
from hnerf.evaluation.evaluate import evaluate
from hnerf.evaluation.holdout import LABEL, collect_held_out, held_out_cameras, score_held_out
from hnerf.evaluation.metrics import mask_box
from tests.evaluation.ball import (
    FRAMES,
    PHOTOGRAPHED,
    RENDERED,
    BallAvatar,
    ball_fit,
    ball_inputs,
    ball_mask,
    centre_m,
    coarse_surfaces,
    tuned,
    write_ball_capture,
    write_ball_truth,
    write_settings,
)

CAMERAS = ("a", "b", "c")


def three_cameras(folder: Path) -> Capture:
    """Return a capture with three training cameras."""
    capture = write_ball_capture(folder)
    return replace(capture, train_cameras=CAMERAS, test_cameras=())


def own_mask(capture: Capture, camera: str, frame: int) -> np.ndarray:
    """Return the mask of the ball without its left half."""
    mask = ball_mask(capture.cameras[camera], centre_m(frame))
    mask[:, : mask.shape[1] // 2] = False
    return mask


def held_out(base: Path, capture: Capture, camera: str) -> tuple[Path, dict[str, Any]]:
    """Score a camera that training did not use; return the output folder and the scores. Frame 1 has no mask."""
    masks = {(n, f): encode(own_mask(capture, n, f)) for n in CAMERAS for f in FRAMES if f != 1}
    training, out = base / "training", base / camera
    for folder in (training, out):
        folder.mkdir(parents=True, exist_ok=True)
    write_settings(training)
    fit = ball_fit()
    avatar = BallAvatar(tuned(fit), RENDERED, frames_darken_by=51)
    scores = score_held_out(capture, Masks(masks, {}), avatar, fit, training, camera, EvaluationSettings(), out)
    return out, scores


def psnr_db(capture: Capture, camera: str, frame: int, grey: int) -> float:
    """Return the PSNR of a rendering that shows the whole ball in a grey level, against a photograph that shows its
    right half."""
    mask, whole = own_mask(capture, camera, frame), ball_mask(capture.cameras[camera], centre_m(frame))
    error = (whole * grey / 255.0 - mask * PHOTOGRAPHED / 255.0)[mask_box(mask)]
    return float(-10 * np.log10((error**2).mean()))


def test_a_held_out_camera_is_scored_on_its_own_masked_photographs(tmp_path: Path) -> None:
    """The ground truth says otherwise and is ignored. Training frames are rendered as trained, novel poses animated."""
    capture = three_cameras(tmp_path / "capture")
    write_ball_truth(capture)
    out, found = held_out(tmp_path, capture, "b")
    assert (found["camera"], found["trained_on"]) == ("b", ["a", "c"])
    assert [(r["camera"], r["frame"]) for r in found["novel_view"]["per_image"]] == [("b", 0), ("b", 2)]
    assert found["novel_view"]["without_mask"] == 1
    of_training_frames = [psnr_db(capture, "b", f, RENDERED - 51) for f in (0, 2)]
    assert found["novel_view"]["psnr"] == pytest.approx(np.mean(of_training_frames), abs=1e-4)
    assert found["novel_pose"]["psnr"] == pytest.approx(psnr_db(capture, "b", 3, RENDERED), abs=1e-4)
    mask, whole = own_mask(capture, "b", 3), ball_mask(capture.cameras["b"], centre_m(3))
    assert found["novel_pose"]["mask_iou"] == pytest.approx(mask.sum() / whole.sum())
    assert sorted(p.name for p in (out / "renders").iterdir()) == ["novel_pose", "novel_view"]


def test_held_out_scores_are_collected_by_camera_with_their_mean(tmp_path: Path) -> None:
    def folder(camera: str, view_db: float | None, pose_db: float | None) -> Path:
        path = tmp_path / camera
        path.mkdir()
        dbs = {"novel_view": view_db, "novel_pose": pose_db}
        scores = {split: {"psnr": db, "ssim": 0.5, "mask_iou": None, "lpips": None} for split, db in dbs.items()}
        (path / "holdout.json").write_text(json.dumps({"camera": camera, "trained_on": ["x", "y"]} | scores))
        return path

    capture = three_cameras(tmp_path / "capture")
    found = collect_held_out(capture, [folder("a", 20.0, None), folder("b", 23.0, 18.0)])["holdout"]
    assert found["what"] == LABEL
    assert list(found["cameras"]) == ["a", "b"]
    assert found["mean"]["novel_view"] == {"psnr": 21.5, "ssim": 0.5, "mask_iou": None, "lpips": None}
    assert found["mean"]["novel_pose"]["psnr"] == 18.0
    with_test_camera = replace(capture, test_cameras=("c",))
    assert "has test cameras" in collect_held_out(with_test_camera, [])["holdout_reason"]


def test_the_report_has_a_row_for_each_held_out_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    coarse_surfaces(monkeypatch)  # they do not matter here
    capture = three_cameras(tmp_path / "capture")
    folders = [held_out(tmp_path, capture, camera)[0] for camera in ("a", "b")]
    inputs = replace(ball_inputs(capture), held_out_folders=tuple(folders))
    found = evaluate(inputs, EvaluationSettings(max_meshes=1, report_rows=1), tmp_path)
    text = (tmp_path / "report.html").read_text()
    assert f"{found['holdout']['mean']['novel_pose']['psnr']:.2f}" in text and LABEL in text.replace("&#39;", "'")
    assert "<th>Camera a</th>" in text and "<th>Camera b</th>" in text and "<th>Camera c</th>" not in text
    assert "<h2>Cameras left out</h2>" in text
    assert cv2.imread(str(folders[0] / "renders" / "novel_pose" / "a" / "000003.png")) is not None


@pytest.mark.parametrize(
    ("train", "test", "holdout", "message"),
    [
        (CAMERAS, (), "d", "evaluation.holdout=d: no such training camera; there are a, b, c"),
        (CAMERAS, ("t",), "d", "evaluation.holdout=d: no such training camera; there are a, b, c"),
        (("a", "b"), (), "a", "evaluation.holdout=a: fewer than 2 of the 2 training cameras would be left"),
        (("a", "b"), (), "each", "evaluation.holdout=each: fewer than 2 of the 2 training cameras would be left"),
    ],
)
def test_cameras_that_cannot_be_left_out_are_refused(
    train: tuple[str, ...], test: tuple[str, ...], holdout: str, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        held_out_cameras(train, test, holdout)


def test_one_camera_or_each_in_turn_is_held_out() -> None:
    assert held_out_cameras(CAMERAS, (), None) == ()
    assert held_out_cameras(CAMERAS, (), "b") == ("b",)
    assert held_out_cameras(CAMERAS, (), "each") == CAMERAS
    assert held_out_cameras(("a", "b"), ("t",), "each") == ()  # test cameras score the capture
    assert held_out_cameras(("a", "b"), ("t",), "a") == ()

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hnerf.capture.capture import write_image
from hnerf.config import EvaluationSettings
from hnerf.evaluation import report
from hnerf.evaluation.report import costs, is_table_rows, readable, reading_notes, stage_reports, summary
from hnerf.evaluation.views import View
from tests.evaluation.ball import ball_inputs, write_ball_capture


def test_values_are_formatted_readably() -> None:
    assert [readable(v) for v in (None, True, 3, 0.123456, "x", [], ["a", 1])] == [
        "–",
        "yes",
        "3",
        "0.1235",
        "x",
        "none",
        "a, 1",
    ]
    assert [readable(v) for v in (9999.4, 9999.7, 12345.6)] == ["9999", "10000", "12346"]
    assert readable([[0.5, 2.0, 1.0]] * 5) == "15 values from 0.5 to 2"


def test_dicts_of_plain_values_become_table_rows() -> None:
    assert is_table_rows([{"a": 1}, {"b": [2]}])
    assert is_table_rows({"x": {"a": 1}}.values())
    assert not is_table_rows({"x": {"a": {"b": 1}}}.values())
    others: list[Any] = [[], "text", 1, None, [1], {"a": {}}]
    assert not any(is_table_rows(value) for value in others)


def test_the_summary_shows_a_dash_for_missing_scores() -> None:
    geometry = {"chamfer_mm": 8.04, "chamfer_l2_e3": 0.1234, "normal_consistency": 0.95, "iou": 0.9}
    view = {"psnr": 30.126, "ssim": 0.9, "mask_iou": 0.95, "geometry": geometry}
    pose = {"psnr": None, "ssim": None, "mask_iou": None, "geometry": None}
    posed, tracked = pose | {"psnr": 28.0}, pose | {"psnr": 29.0}
    found = {"novel_view": view, "novel_pose": pose, "novel_pose_posed": posed, "novel_pose_tracked": tracked}
    values = {row["name"]: row["values"] for row in summary(found)}
    assert values["PSNR"] == ["30.13", "–", "28.00", "29.00"]
    assert values["Surface distance"] == ["8.0", "–", "–", "–"]
    assert values["Chamfer"] == ["0.123", "–", "–", "–"]


def test_costs_have_a_row_for_each_part_of_a_stage() -> None:
    stages = {
        "Calibration": {},
        "Body fit": {"seconds": {"start": 0.5, "outlines": 12.25}},
        "Training": {"seconds": 60.0},
    }
    assert costs(stages, {"seconds": {"rendering": 3.5}, "seconds_per_image": 0.1}) == [
        ("Body fit: start, seconds", "0.5"),
        ("Body fit: outlines, seconds", "12.25"),
        ("Training, seconds", "60"),
        ("Evaluation: rendering, seconds", "3.5"),
        ("Rendering, seconds per image", "0.1"),
    ]


def test_costs_include_the_duration_of_the_body_fit(tmp_path: Path) -> None:
    inputs = ball_inputs(write_ball_capture(tmp_path / "capture"))
    stages = stage_reports(replace(inputs, fit_seconds={"start": 0.5}))
    assert costs(stages, {"seconds_per_image": 0.1})[0] == ("Body fit: start, seconds", "0.5")


def test_notes_list_unscored_images_and_the_reference(tmp_path: Path) -> None:
    inputs = ball_inputs(write_ball_capture(tmp_path / "capture"))
    view = {"reference": "image x ground-truth mask", "without_mask": 3, "without_person": 2}
    rain = {f"novel_pose{column}": {"reason": "rain"} for column in ("", "_posed", "_tracked")}
    found = {"lpips": "not available: no weights", "novel_view": view} | rain
    assert reading_notes(inputs, found) == [
        "LPIPS is not available: no weights.",
        "New poses, animated; New poses, posed; New poses, tracked: no image scores: rain.",
        "New views: compared to photographs under the true mask, whose edge pixels contain background.",
        "New views: 3 images have no mask to score them by.",
        "New views: 2 images do not show the person and are not scored.",
    ]


def test_the_worst_image_of_a_split_is_shown_with_a_label(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The only row of samples shows the split's first frame; the worst image is in another frame."""
    capture = write_ball_capture(tmp_path)
    for frame in (0, 1, 2):
        write_image(View("novel_view", "c", frame).path(tmp_path), np.zeros((64, 64, 4), np.uint8))
    psnr = {0: 30.0, 1: 20.0, 2: 40.0}
    found: Any = {"holdout": None, "novel_pose": {"per_image": []}}
    found["novel_view"] = {"per_image": [{"camera": "c", "frame": f, "psnr": db} for f, db in psnr.items()]}
    monkeypatch.setattr(report, "view_row", lambda view, *given: (view.frame, given[3]))
    monkeypatch.setattr(report, "surface_gallery", lambda *_: None)
    inputs = ball_inputs(capture)
    shown, _ = report.galleries(inputs, EvaluationSettings(report_rows=1), None, {}, found, tmp_path)
    assert shown.rows == [(0, ""), (1, "the worst of this split, 20.0 dB")]

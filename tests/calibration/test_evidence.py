"""All three kinds of evidence, on a rendered capture with a damaged calibration."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from hnerf.calibration.calibrated import load_cameras
from hnerf.calibration.check import check_calibration
from hnerf.calibration.diagnosis import measure
from hnerf.calibration.evidence import Evidence
from hnerf.calibration.matches import Matches
from hnerf.calibration.sheet import _scatter, draw_evidence
from hnerf.calibration.silhouettes import MaskOutline, Outlines
from hnerf.capture.capture import Capture
from hnerf.capture.subject import ranked_people
from hnerf.config import CalibrationSettings
from tests.calibration.synthetic import turned


def test_evidence_before_and_after_refining_a_turned_camera(
    wave: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hnerf.calibration.refine.FRAMES", 4)
    monkeypatch.setattr("hnerf.calibration.outline_adjustment.EVALUATIONS", 6)
    monkeypatch.setattr("hnerf.calibration.silhouettes.POINTS", 32)
    off = wave.with_cameras(wave.cameras | {"02": turned(wave.cameras["02"], 2.0)})
    report = check_calibration(off, CalibrationSettings())
    report.save(tmp_path)
    stored = json.loads((tmp_path / "report.json").read_text())
    given, used = stored["witnesses"]["as_given"], stored["witnesses"]["as_used"]
    assert set(given) == set(used) == {"keypoints", "silhouettes", "matches", "match_pairs"}
    assert given["keypoints"]["02"]["median_px"] > used["keypoints"]["02"]["median_px"] + 1
    # Two degrees at a focal length of 249 px are 8.7 px; most rays in the mean cannot miss.
    means_px = [
        sum(summary["silhouettes"][name]["mean_px"] for name in wave.train_cameras) for summary in (given, used)
    ]
    assert means_px[0] > 2 and means_px[1] < 0.5
    assert used["matches"]["02"] == {"count": 0, "reason": "no overlap: no matches"}
    sheet = cv2.imread(str(tmp_path / "witnesses.png"))
    assert sheet is not None and sheet.shape[0] > 1000
    assert cv2.imread(str(tmp_path / "cameras.png")) is not None
    assert load_cameras(tmp_path, off).train_cameras == wave.train_cameras


def test_matches_of_a_pair_count_for_both_cameras_and_missing_evidence_is_named(wave: Capture, tmp_path: Path) -> None:
    # One point in the world, 3 px too low in the first camera: a residual of up to 3 px, shared between both images.
    cameras = [wave.cameras[name] for name in wave.train_cameras]
    keypoints = ranked_people(wave)[0].keypoints
    point_m = np.array([[0.1, 0.2, 1.0]])
    matched = np.stack([camera.project(point_m)[0] for camera in cameras[:2]], 1)
    matched[0, 0, 1] += 3
    outlines = Outlines({"01": [None], "02": [None]}, (0,))
    evidence = Evidence(wave, keypoints, outlines, Matches({("01", "02"): matched}, wave.frames[0]), None)
    summary = evidence.summarise(cameras, measure(cameras, keypoints))
    assert summary["matches"]["01"] == summary["matches"]["02"] == summary["match_pairs"]["01 and 02"]
    assert summary["matches"]["01"]["count"] == 1 and 1 < summary["matches"]["01"]["median_px"] < 3
    assert summary["silhouettes"] == {"01": {"rays": 0}, "02": {"rays": 0}}
    draw_evidence(tmp_path / "sheet.png", evidence, cameras, measure(cameras, keypoints))
    assert cv2.imread(str(tmp_path / "sheet.png")) is not None
    nothing = dataclasses.replace(evidence, outlines=None, matches=Matches({}, 0))
    summary = nothing.summarise(cameras, measure(cameras, keypoints))
    assert summary["silhouettes"].startswith("none: ") and summary["match_pairs"] == "no overlap: no matches"


def test_the_sheet_computes_outline_residuals_twice_and_draws_no_outline_seen_by_one_camera_only(
    wave: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the middle instant, which is drawn, only one camera has an outline, so its residuals are unknown."""
    cameras = [wave.cameras[name] for name in wave.train_cameras]
    keypoints = ranked_people(wave)[0].keypoints
    disc = np.zeros(cameras[0].size_px[::-1], np.uint8)
    outline = MaskOutline.around(cv2.circle(disc, (disc.shape[1] // 2, disc.shape[0] // 2), 40, 1, cv2.FILLED) > 0)
    outlines = Outlines({"01": [outline, outline], "02": [outline, None]}, (0, 1))
    evidence = Evidence(wave, keypoints, outlines, Matches({}, wave.frames[0]), None)
    drawn, calls = [], []
    residuals_px = Outlines.residuals_px
    monkeypatch.setattr(Outlines, "residuals_px", lambda *given: calls.append(given) or residuals_px(*given))
    monkeypatch.setattr("hnerf.calibration.sheet._scatter", lambda *given: drawn.append(given) or _scatter(*given))
    draw_evidence(tmp_path / "sheet.png", evidence, cameras, measure(cameras, keypoints))
    assert len(drawn) == len(cameras)  # keypoints alone
    assert len(calls) == 2

"""All three kinds of evidence on a rendered capture with a spoilt calibration."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from hnerf.calibration.check import check_calibration
from hnerf.calibration.diagnosis import measure
from hnerf.calibration.evidence import Evidence
from hnerf.calibration.matches import Matches
from hnerf.calibration.report import load_cameras
from hnerf.calibration.sheet import draw_evidence
from hnerf.calibration.silhouettes import Outlines
from hnerf.capture.capture import Capture
from hnerf.capture.subject import subject_keypoints
from hnerf.config import CalibrationSettings
from tests.calibration.synthetic import turned


def test_a_turned_camera_before_and_after(wave: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    # Two degrees at a focal length of 249 px are 8.7 px; the mean is over rays of which most cannot miss.
    means_px = [sum(said["silhouettes"][name]["mean_px"] for name in wave.train_cameras) for said in (given, used)]
    assert means_px[0] > 2 and means_px[1] < 0.5
    assert used["matches"]["02"] == {"count": 0, "reason": "no overlap: no matches"}
    sheet = cv2.imread(str(tmp_path / "witnesses.png"))
    assert sheet is not None and sheet.shape[0] > 1000
    assert cv2.imread(str(tmp_path / "cameras.png")) is not None
    assert load_cameras(tmp_path, off).train_cameras == wave.train_cameras


def test_matches_of_a_pair_speak_for_both_cameras(wave: Capture, tmp_path: Path) -> None:
    # One point of the world, 3 px too low in the first camera: up to 3 px, shared between both images.
    cameras = [wave.cameras[name] for name in wave.train_cameras]
    found = subject_keypoints(wave)
    keypoints = np.stack([found[name] for name in wave.train_cameras])
    point_m = np.array([[0.1, 0.2, 1.0]])
    matched = np.stack([camera.project(point_m)[0] for camera in cameras[:2]], 1)
    matched[0, 0, 1] += 3
    outlines = Outlines({"01": [None], "02": [None]}, (0,))
    evidence = Evidence(wave, keypoints, outlines, Matches({("01", "02"): matched}, wave.frames[0]), None)
    said = evidence.summarise(cameras, measure(cameras, keypoints))
    assert said["matches"]["01"] == said["matches"]["02"] == said["match_pairs"]["01 and 02"]
    assert said["matches"]["01"]["count"] == 1 and 1 < said["matches"]["01"]["median_px"] < 3
    assert said["silhouettes"] == {"01": {"rays": 0}, "02": {"rays": 0}}
    draw_evidence(tmp_path / "sheet.png", evidence, cameras, measure(cameras, keypoints))
    assert cv2.imread(str(tmp_path / "sheet.png")) is not None


def test_without_masks_the_report_says_so(wave: Capture) -> None:
    cameras = [wave.cameras[name] for name in wave.train_cameras]
    keypoints = np.stack([subject_keypoints(wave)[name] for name in wave.train_cameras])
    said = Evidence(wave, keypoints, None, Matches({}, 0), None).summarise(cameras, measure(cameras, keypoints))
    assert said["silhouettes"].startswith("none: ") and said["match_pairs"] == "no overlap: no matches"


def test_one_camera_is_judged_by_the_ground(wave: Capture) -> None:
    report = check_calibration(dataclasses.replace(wave, train_cameras=("01",)), CalibrationSettings())
    assert report.evidence is None
    assert any("standing on world height 0 the person is 1.7" in r for r in report.verdicts["01"].reasons)

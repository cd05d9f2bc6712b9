"""Trials of the calibration stage on broken cameras."""

from pathlib import Path

import pytest
from calibration import evidence_collected_once

from hnerf.calibration.check import check_calibration
from hnerf.calibration.matches import Matches
from hnerf.calibration.outline_adjustment import FRAMES
from hnerf.calibration.silhouettes import Outlines
from hnerf.config import CalibrationSettings
from tests.calibration.synthetic import detections, ring, turned, write_capture
from tests.calibration.test_refine import OutlinesCosting


def test_a_trial_refines_a_turned_camera_with_outlines_collected_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stage collects outlines of few frames as evidence, and of FRAMES if a camera was refined."""
    whole, collected = write_capture(tmp_path, ring(4), detections(ring(4), 1)), []

    def collect(capture: object, *frames: int) -> OutlinesCosting:
        collected.append((capture, *frames))
        return OutlinesCosting([], 0.0, 0.0)

    monkeypatch.setattr(Outlines, "of", collect)
    monkeypatch.setattr(Matches, "of", lambda _: Matches({}, 0))
    broken = whole.with_cameras(whole.cameras | {"c2": turned(whole.cameras["c2"], 1.0)})
    with evidence_collected_once(whole):
        report = check_calibration(broken, CalibrationSettings())
        Outlines.of(broken, FRAMES)
    assert {name: verdict.status for name, verdict in report.verdicts.items()} == {
        "c0": "ok",
        "c1": "ok",
        "c2": "refined",
        "c3": "ok",
    }
    assert collected == [(whole,), (whole, FRAMES)]

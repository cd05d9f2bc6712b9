"""Calibration report: numbers, reasons in words, plots, and the cameras to use (calibrated.py reads them)."""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hnerf.calibration.diagnosis import Measure
from hnerf.calibration.evidence import Evidence
from hnerf.calibration.picture import draw_cameras
from hnerf.calibration.sheet import draw_evidence
from hnerf.calibration.synchronise import Timing
from hnerf.capture.formats.easymocap import write_easymocap
from hnerf.capture.lens import pinhole
from hnerf.geometry.camera import Camera
from hnerf.results.files import write_result
from hnerf.results.preparation import CalibrationCheck

DECIMALS = 4  # of pixels, metres, frames and shares: a tenth of a millimetre, far below what is measured
NO_KEYPOINTS = Timing(reason="no keypoints")
SEVERITY = ("ok", "refined", "suspect", "rejected")


@dataclass(frozen=True)
class CameraVerdict:
    """Verdict on one camera. status: one of SEVERITY; residuals in pixels, None if none were measured, as with one
    camera; frame_offset: the corrected offset, the frame of this camera at the others' frame 0; timing: the offset as
    measured; reasons: in words."""

    status: str
    median_px: float | None = None
    p95_px: float | None = None
    median_before_px: float | None = None
    p95_before_px: float | None = None
    frame_offset: float = 0.0
    timing: Timing = NO_KEYPOINTS
    reasons: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as plain types for JSON."""
        timing = self.timing
        offset = {
            "observable": not timing.reason,
            "frames": timing.offset_frames,
            "standard_error_frames": timing.error_frames,
            "reason": timing.reason,
        }
        return dataclasses.asdict(self) | {"timing": offset}


@dataclass(frozen=True)
class CalibrationReport:
    """Result of the calibration check.

    cameras: those to use from here on, test cameras included; verdicts: of the training cameras; notes: about the whole
    rig, and checks that could not be made; doubts: what in the recording contradicts the calibration; before, after,
    evidence: None with one training camera, or without keypoints; held_out_px, outlines_px: cost of each correction
    that was tried, on held-out frames and by the person's outlines.
    """

    cameras: dict[str, Camera]
    verdicts: dict[str, CameraVerdict]
    up: str
    notes: tuple[str, ...]
    doubts: tuple[str, ...] = ()
    before: Measure | None = None
    after: Measure | None = None
    evidence: Evidence | None = None
    held_out_px: dict[str, float] = dataclasses.field(default_factory=dict)
    outlines_px: dict[str, float] = dataclasses.field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """Return the most severe status among the training cameras."""
        return max((v.status for v in self.verdicts.values()), key=SEVERITY.index)

    def save(self, out: Path) -> None:
        """Write `intri.yml` and `extri.yml` (EasyMocap, without rejected cameras), `report.json`, `cameras.png`, and
        `witnesses.png` if there is evidence."""
        out.mkdir(parents=True, exist_ok=True)
        rejected = {name for name, v in self.verdicts.items() if v.status == "rejected"}
        write_easymocap(out, [pinhole(camera) for name, camera in self.cameras.items() if name not in rejected])
        write_result(out / "report.json", CalibrationCheck, _rounded(self._to_dict()))
        status = {name: self.verdicts[name].status if name in self.verdicts else "unjudged" for name in self.cameras}
        draw_cameras(out / "cameras.png", list(self.cameras.values()), status, self.up, self.before, self.after)
        if self.evidence and self.after:
            used = [self.cameras[name] for name in self.evidence.capture.train_cameras]
            draw_evidence(out / "witnesses.png", self.evidence, used, self.after)

    def _to_dict(self) -> dict[str, Any]:
        measured = {"before": self.before, "after": self.after}
        return {
            "verdict": self.verdict,
            "doubts": self.doubts,
            "cameras": {name: v.to_dict() for name, v in self.verdicts.items()},
            "unjudged_cameras": [name for name in self.cameras if name not in self.verdicts],
            "body_height_m": self.after and self.after.body_height_m,
            "trimmed_cost_px": {when: found and found.cost_px for when, found in measured.items()},
            "trimmed_cost_without_px": {when: found and found.cost_without_px for when, found in measured.items()},
            "held_out_cost_px": self.held_out_px,
            "outlines_cost_px": self.outlines_px,
            "notes": self.notes,
            "witnesses": self._evidence_to_dict(),
        }

    def _evidence_to_dict(self) -> dict[str, Any]:
        """Return the evidence about the cameras as given and as used; empty if there is none."""
        if self.evidence is None or self.before is None or self.after is None:
            return {}
        given, judged = self.evidence.capture.cameras, self.evidence.capture.train_cameras
        return {
            "as_given": self.evidence.summarise([given[name] for name in judged], self.before),
            "as_used": self.evidence.summarise([self.cameras[name] for name in judged], self.after),
            "board_footage": self.evidence.boards or "none: the recording has no calibration/ footage of a board",
        }


def _rounded(tree: Any) -> Any:
    """Return the tree with numbers to DECIMALS places, so that identical runs, whose sums differ in the last digits,
    write identical reports; and with NaN and infinity replaced by None, because JSON has neither."""
    if isinstance(tree, dict):
        return {key: _rounded(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [_rounded(value) for value in tree]
    if isinstance(tree, float):
        return round(tree, DECIMALS) + 0.0 if math.isfinite(tree) else None  # + 0.0 turns -0.0 into 0.0
    return tree

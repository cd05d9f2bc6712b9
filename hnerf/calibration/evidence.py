"""Evidence about each camera: residuals of keypoints, silhouettes and image matches, side by side."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from hnerf.calibration.boards.calibrate import board_evidence
from hnerf.calibration.diagnosis import Measure
from hnerf.calibration.matches import Matches
from hnerf.calibration.silhouettes import Outlines
from hnerf.capture.capture import Capture
from hnerf.geometry.camera import Camera

NO_OUTLINES = (
    "fewer than two cameras have a mask, or a background from which one could be made, or no frame shows the person in "
    "all of them"
)
NO_MATCHES = "no overlap: no matches"


@dataclasses.dataclass(frozen=True)
class Evidence:
    """Evidence by which any poses of the training cameras can be judged, collected once.

    keypoints (C, frames, 25, 3) of the subject in `capture`. outlines: None if there are no masks. boards: the result
    of `board_evidence` for the cameras as given, None without footage of a calibration board.
    """

    capture: Capture
    keypoints: np.ndarray
    outlines: Outlines | None
    matches: Matches
    boards: dict[str, Any] | None

    @staticmethod
    def of(capture: Capture, keypoints: np.ndarray) -> "Evidence":
        """Collect the evidence of a capture: the given keypoints, and what its images show."""
        return Evidence(capture, keypoints, Outlines.of(capture), Matches.of(capture), board_evidence(capture))

    def summarise(self, cameras: Sequence[Camera], found: Measure) -> dict[str, Any]:
        """Return the residuals in pixels of each kind of evidence for each of these cameras. found: what `measure`
        returns for them."""
        outlines_px = self.outlines.residuals_px(cameras) if self.outlines else {}
        matches_px = self.matches.residuals_px(cameras)
        names = [camera.name for camera in cameras]
        return {
            "keypoints": {name: _keypoints(name, found) for name in names},
            "silhouettes": {name: _silhouettes(outlines_px[name]) for name in names if name in outlines_px}
            or f"none: {NO_OUTLINES}",
            "matches": {name: _matches(name, matches_px) for name in names},
            "match_pairs": {" and ".join(pair): _summary(px) for pair, px in matches_px.items()} or NO_MATCHES,
        }


def _keypoints(name: str, found: Measure) -> dict[str, Any]:
    return {
        "median_px": found.median_px[name],
        "p95_px": found.p95_px[name],
        "cost_of_the_others_px": found.cost_without_px.get(name),
    }


def _silhouettes(residuals_px: np.ndarray) -> dict[str, Any]:
    """Summarise the residuals of one camera's outline. Most rays pass through the middle of the other cameras' visual
    hull, so mean and tail say more than the median."""
    if len(residuals_px) == 0:
        return {"rays": 0}
    return {
        "rays": len(residuals_px),
        "mean_px": float(residuals_px.mean()),
        "median_px": float(np.median(residuals_px)),
        "p95_px": float(np.percentile(residuals_px, 95)),
    }


def _matches(name: str, residuals_px: dict[tuple[str, str], np.ndarray]) -> dict[str, Any]:
    own = [px for pair, px in residuals_px.items() if name in pair]
    return _summary(np.concatenate(own)) if own else {"count": 0, "reason": NO_MATCHES}


def _summary(residuals_px: np.ndarray) -> dict[str, Any]:
    return {"count": len(residuals_px), "median_px": float(np.median(residuals_px))}

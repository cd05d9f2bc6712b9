"""Masks of the person in a capture, kept as PNG so that many fit in memory."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hnerf.errors import InputError
from hnerf.results.files import write_result
from hnerf.results.preparation import SegmentationReport


@dataclass(frozen=True)
class Masks:
    """Masks of a capture. encoded: PNG bytes of 0/255 by (camera, frame), without dropped masks; report: plain
    values."""

    encoded: dict[tuple[str, int], bytes]
    report: dict[str, Any]

    def __contains__(self, view: tuple[str, int]) -> bool:
        """Return whether this (camera, frame) has a mask that can be trusted."""
        return view in self.encoded

    def get(self, camera: str, frame: int) -> np.ndarray:
        """Return a mask, (H, W) bool, True on the person."""
        png = np.frombuffer(self.encoded[camera, frame], np.uint8)
        mask = cv2.imdecode(png, cv2.IMREAD_GRAYSCALE)
        if mask is None:
            raise InputError(f"masks/{camera}/{frame:06d}.png: not a readable image; run the segmentation stage again")
        return mask > 127

    def save(self, out: Path) -> None:
        """Write `masks/<camera>/<frame:06d>.png` and `report.json`."""
        for (camera, frame), png in self.encoded.items():
            path = out / "masks" / camera / f"{frame:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(png)
        write_result(out / "report.json", SegmentationReport, self.report)

    @staticmethod
    def load(out: Path) -> "Masks":
        """Read what `save` wrote."""
        files = sorted((out / "masks").glob("*/*.png"))
        encoded = {(path.parent.name, int(path.stem)): path.read_bytes() for path in files}
        return Masks(encoded, json.loads((out / "report.json").read_text()))


def encode(mask: np.ndarray) -> bytes:
    """Encode a mask (H, W) bool as PNG bytes of 0/255."""
    return cv2.imencode(".png", 255 * mask.astype(np.uint8))[1].tobytes()


def movement_px(before: Masks, after: Masks) -> float:
    """Return the mean, over the views in which both have an edge, of the mean distance from the edges after to the
    edges before; infinity without such a view. A mask that fills the image has no edge."""
    pairs = ((outline(before.get(*view)), outline(after.get(*view))) for view in after.encoded if view in before)
    moved = [_edge_distance_px(*pair) for pair in pairs if pair[0].any() and pair[1].any()]
    return float(np.mean(moved)) if moved else float("inf")


def outline(mask: np.ndarray) -> np.ndarray:
    """Return the outermost pixels of a mask (H, W) bool, without those that only the image's border cuts off."""
    return mask & ~cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)


def _edge_distance_px(before: np.ndarray, after: np.ndarray) -> float:
    """Return the mean distance in pixels from the pixels `after`, (H, W) bool, to the nearest of `before`."""
    away_px = cv2.distanceTransform((~before).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return float(away_px[after].mean())

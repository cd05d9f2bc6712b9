"""Contact sheet of the evidence: keypoints, outlines and matches of each camera under the cameras used."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from hnerf.calibration.diagnosis import Measure
from hnerf.calibration.evidence import NO_MATCHES, Evidence
from hnerf.calibration.silhouettes import MaskOutline
from hnerf.capture.body_25 import FEET, LIMBS
from hnerf.geometry.camera import Camera

SCALE_PX = Normalize(0, 10)  # range of residuals, from green to red
COLOURS = "RdYlGn_r"
BRIGHTNESS = 0.55  # of the photographs, darkened so that the marks stand out
MARGIN = 0.12  # of the person's size
PANEL_INCHES = 4.2


def draw_evidence(path: Path, evidence: Evidence, cameras: Sequence[Camera], found: Measure) -> None:
    """Write the sheet as PNG, one row per camera. found: what `measure` returns for these cameras."""
    capture, outlines = evidence.capture, evidence.outlines
    middle = len(outlines.instants) // 2 if outlines else 0
    instant = outlines.instants[middle] if outlines else len(capture.frames) // 2
    every_px = outlines.residuals_px(cameras) if outlines else {}
    shown_px = outlines.select(slice(middle, middle + 1)).residuals_px(cameras) if outlines else {}
    figure = Figure(figsize=(3 * PANEL_INCHES + 1, PANEL_INCHES * len(cameras) + 0.6), layout="constrained")
    panels = figure.subplots(len(cameras), 3, squeeze=False)
    for row, camera, detected in zip(panels, cameras, evidence.keypoints[:, instant], strict=True):
        for axes, frame in zip(row, [*[capture.frames[instant]] * 2, evidence.matches.frame], strict=True):
            axes.imshow((BRIGHTNESS * capture.image(camera.name, frame)).astype(np.uint8))
            axes.set_axis_off()
        marks = _draw_keypoints(row[0], camera, detected, found.points_m[instant])
        outline = outlines.by_camera[camera.name][middle] if outlines and camera.name in every_px else None
        _draw_outline(row[1], camera.name, outline, every_px, shown_px)
        _draw_matches(row[2], cameras, camera, evidence)
        message = f"{camera.name}: keypoints, median {found.median_px[camera.name]:.1f} px"
        row[0].set_title(f"{message}, 95 % below {found.p95_px[camera.name]:.1f} px", fontsize=10)
        for axes in row[:2]:
            _zoom(axes, detected[detected[:, 2] > 0, :2])
    figure.colorbar(marks, ax=panels, shrink=0.6 / len(cameras), aspect=20, label="px", extend="max")
    figure.savefig(path, dpi=80)


def _draw_keypoints(axes: Axes, camera: Camera, detected: np.ndarray, points_m: np.ndarray) -> PathCollection:
    """Draw detections (25, 3) as discs, coloured by their distance from the person's projected joints (25, 3), which
    are drawn as lines."""
    uv, _ = camera.project(points_m)
    for a, b in LIMBS + FEET:
        axes.plot(*uv[[a, b]].T, color="white", linewidth=1)
    seen = detected[:, 2] > 0
    return _scatter(axes, detected[seen, :2], np.linalg.norm(uv[seen] - detected[seen, :2], axis=-1), 26)


def _draw_outline(
    axes: Axes,
    name: str,
    outline: MaskOutline | None,
    every_px: Mapping[str, np.ndarray],
    shown_px: Mapping[str, np.ndarray],
) -> None:
    """Draw points of the outline, coloured by how far their rays miss the visual hull of the other cameras, `shown_px`,
    which is empty if no other camera has an outline then. every_px: the same for all instants."""
    if outline is None or len(shown_px[name]) == 0:
        axes.set_title(f"{name}: no outline", fontsize=10)
        return
    residuals_px = every_px[name]
    message = f"mean {residuals_px.mean():.2f} px, 95 % below {np.percentile(residuals_px, 95):.1f} px"
    axes.set_title(f"{name}: outline, {message}", fontsize=10)
    _scatter(axes, outline.points_px, shown_px[name], 14)


def _draw_matches(axes: Axes, cameras: Sequence[Camera], camera: Camera, evidence: Evidence) -> None:
    """Draw matches with other cameras, coloured by their distance from the epipolar constraint."""
    message = []
    for pair, residuals_px in evidence.matches.residuals_px(cameras).items():
        if camera.name in pair:
            side = pair.index(camera.name)
            _scatter(axes, evidence.matches.by_pair[pair][:, side], residuals_px, 14)
            message.append(f"{len(residuals_px)} with {pair[1 - side]}, median {np.median(residuals_px):.1f} px")
    axes.set_title(f"{camera.name}: " + (f"matches, {'; '.join(message)}" if message else NO_MATCHES), fontsize=10)


def _scatter(axes: Axes, points_px: np.ndarray, residuals_px: np.ndarray, size: float) -> PathCollection:
    x, y = points_px.T
    marks = axes.scatter(x, y, size, residuals_px, cmap=COLOURS, norm=SCALE_PX)
    marks.set(edgecolor="black", linewidth=0.3)
    return marks


def _zoom(axes: Axes, points_px: np.ndarray) -> None:
    """Set a square window around the person's points (n, 2)."""
    if len(points_px) == 0:
        return
    low, high = points_px.min(0), points_px.max(0)
    half = (0.5 + MARGIN) * float((high - low).max())
    x, y = (low + high) / 2
    axes.set(xlim=(x - half, x + half), ylim=(y + half, y - half))

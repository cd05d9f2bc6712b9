"""Plot of the calibration: cameras and person from above and from the side, and residuals."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hnerf.calibration.diagnosis import Measure
from hnerf.capture.body_25 import FEET, LIMBS
from hnerf.geometry.camera import Camera

SHOWN_FRAMES = 5
FRUSTUM_SHARE = 0.15  # of the distance to the person
COLOURS = {"ok": "tab:green", "refined": "tab:blue", "suspect": "tab:orange", "rejected": "tab:red", "unjudged": "0.6"}


def draw_cameras(
    path: Path,
    cameras: Sequence[Camera],
    status: dict[str, str],
    up: str,
    before: Measure | None,
    after: Measure | None,
) -> None:
    """Write the plot as PNG. status: by camera name; before, after: what `measure` returned, None with
    one camera, or without keypoints."""
    figure = Figure(figsize=(16, 5.5), layout="constrained")
    above, side, bars = figure.subplots(1, 3)
    vertical = "xyz".index(up)
    first, second = (axis for axis in range(3) if axis != vertical)
    points_m = np.zeros((0, 25, 3)) if after is None else after.points_m
    for axes, across, along, title in ((above, first, second, "from above"), (side, first, vertical, "from the side")):
        _draw_scene(axes, cameras, status, points_m, (across, along))
        axes.set(title=title, xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[along]} (m)")
        axes.set_aspect("equal", adjustable="datalim")
    if up == "y":
        above.invert_yaxis()  # x right and z down, or it would be the view from below
    if before is not None and after is not None:
        _draw_bars(bars, before, after, status)
    else:
        judged = sum(verdict != "unjudged" for verdict in status.values())
        bars.text(0.5, 0.5, f"{'one camera' if judged == 1 else 'no keypoints'}: no residuals", ha="center")
        bars.set_axis_off()
    figure.savefig(path, dpi=90)


def _draw_scene(
    axes: Axes, cameras: Sequence[Camera], status: dict[str, str], points_m: np.ndarray, shown: tuple[int, int]
) -> None:
    """Draw camera frusta and the person's limbs, points (frames, 25, 3), projected onto one plane of the world."""
    person_m = np.nanmedian(points_m.reshape(-1, 3), axis=0) if len(points_m) else np.zeros(3)
    for pose_m in points_m[:: max(1, len(points_m) // SHOWN_FRAMES)]:
        for a, b in LIMBS + FEET:
            axes.plot(*pose_m[[a, b]][:, shown].T, color="0.3", linewidth=0.8)
    for camera in cameras:
        colour = COLOURS[status[camera.name]]
        centre = camera.centre_m
        width, height = camera.width_px - 1, camera.height_px - 1
        corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
        reach_m = FRUSTUM_SHARE * float(np.linalg.norm(person_m - centre))
        ends = centre + reach_m * camera.rays(corners)[1]
        for i in range(4):
            axes.plot(*np.stack([centre, ends[i], ends[i - 1]])[:, shown].T, color=colour, linewidth=1)
        axes.annotate(camera.name, (centre[shown[0]], centre[shown[1]]), color=colour)


def _draw_bars(axes: Axes, before: Measure, after: Measure, status: dict[str, str]) -> None:
    names = list(before.median_px)
    at = np.arange(len(names))
    axes.bar(at - 0.2, [before.median_px[n] for n in names], 0.4, color="0.8", label="as given, median")
    colours = [COLOURS[status[n]] for n in names]
    axes.bar(at + 0.2, [after.median_px[n] for n in names], 0.4, color=colours, label="as used, median")
    p95_px = [after.p95_px[n] for n in names]
    axes.scatter(at + 0.2, p95_px, color="black", marker="_", label="as used, 95th percentile")
    axes.set_xticks(at, [f"{n}\n{status[n]}" for n in names])
    axes.set(title="reprojection of keypoints", ylabel="px")
    axes.legend()

"""Charts of the training history and of scores by frame, as PNG files."""

from collections import defaultdict
from itertools import cycle
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hnerf.results.scores import ImageScores

COLOURS = ("#1f5fa8", "#e0701a", "#2b8a57", "#b23a48", "#6a4c93", "#8a6d3b", "#11808a", "#9a9a9a", "#d14d9a", "#3d3d3d")
INK, FAINT = "#25292e", "#d9dde2"

Points = list[tuple[float, float]]


def loss_chart(history: list[dict[str, Any]], path: Path) -> bool:
    """Draw every loss over training time, on a logarithmic scale. Return whether there was one to draw and the file was
    written."""
    series: dict[str, Points] = defaultdict(list)
    for record in history:
        for name, value in record["losses"].items():
            series[name] += [(record["seconds"], value)] if value > 0 else []
    return _chart(path, {k: v for k, v in series.items() if v}, "seconds of training", "loss", "log")


def quality_chart(history: list[dict[str, Any]], path: Path) -> bool:
    """Draw the PSNR on held-out frames over training time. Return whether there was one to draw and the file was
    written."""
    points = [(record["seconds"], record["held_out"]["psnr"]) for record in history if "held_out" in record]
    return _chart(path, {"": points} if points else {}, "seconds of training", "held-out psnr")


def frame_chart(per_image: list[ImageScores], path: Path) -> bool:
    """Draw the PSNR of every frame, one line per camera. Return whether an image was scored and the file was
    written."""
    series: dict[str, Points] = defaultdict(list)
    for score in per_image:
        series[f"camera {score['camera']}"].append((score["frame"], score["psnr"]))
    return _chart(path, series, "frame", "PSNR, dB")


def _chart(path: Path, series: dict[str, Points], x_label: str, y_label: str, scale: str = "linear") -> bool:
    """Draw a line for each series; the legend has their names, unless the only one has none. Return whether there was
    one to draw and the file was written."""
    if not series:
        return False
    figure = Figure(figsize=(9.6, 3.4), dpi=150, layout="constrained")
    axes = figure.subplots()
    for colour, (name, points) in zip(cycle(COLOURS), series.items(), strict=False):
        marker = "o" if len(points) < 40 else None
        axes.plot(*zip(*points, strict=True), color=colour, linewidth=1.6, marker=marker, markersize=3, label=name)
    axes.set_yscale(scale)
    if any(series):
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=9, labelcolor=INK)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    style(axes, x_label, y_label)
    figure.savefig(path, facecolor="white")
    return True


def style(axes: Axes, x_label: str, y_label: str) -> None:
    """Set the labels and the style that all charts share."""
    axes.set_xlabel(x_label, color=INK)
    axes.set_ylabel(y_label, color=INK)
    axes.grid(color=FAINT, linewidth=0.7)
    axes.tick_params(colors=INK, labelsize=9)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(FAINT)

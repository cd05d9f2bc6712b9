"""Charts of the training history and of scores by frame, as PNG files."""

from collections import defaultdict
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hnerf.results import ImageScores

COLOURS = ("#1f5fa8", "#e0701a", "#2b8a57", "#b23a48", "#6a4c93", "#8a6d3b", "#11808a", "#9a9a9a", "#d14d9a", "#3d3d3d")
INK, FAINT = "#25292e", "#d9dde2"

Points = list[tuple[float, float]]


def loss_chart(history: list[dict[str, Any]], path: Path) -> bool:
    """Draw every loss over training time, on a logarithmic scale. Return whether there was one to draw and the file was
    written."""
    series = _series(history, "losses")
    positive = {name: [(s, v) for s, v in points if v > 0] for name, points in series.items()}
    return _chart(path, {k: v for k, v in positive.items() if v}, "seconds of training", "loss", "log")


def quality_chart(history: list[dict[str, Any]], path: Path) -> bool:
    """Draw held-out scores over training time, one panel each. Return whether there was one to draw and the file was
    written."""
    series = _series(history, "held_out")
    if not series:
        return False
    figure, panels = _figure(len(series))
    for axes, colour, (name, points) in zip(panels, COLOURS, series.items(), strict=False):
        _line(axes, points, colour, None)
        _finish(axes, "seconds of training", f"held-out {name}")
    figure.savefig(path, facecolor="white")
    return True


def frame_chart(per_image: list[ImageScores], path: Path) -> bool:
    """Draw the PSNR of every frame, one line per camera. Return whether an image was scored and the file was
    written."""
    series: dict[str, Points] = defaultdict(list)
    for score in per_image:
        series[f"camera {score['camera']}"].append((score["frame"], score["psnr"]))
    return _chart(path, series, "frame", "PSNR, dB", "linear")


def _series(history: list[dict[str, Any]], key: str) -> dict[str, Points]:
    """Return, by name, the values under a key of every record, over seconds."""
    series: dict[str, Points] = defaultdict(list)
    for record in history:
        for name, value in record.get(key, {}).items():
            series[name].append((record["seconds"], value))
    return series


def _chart(path: Path, series: dict[str, Points], x_label: str, y_label: str, scale: str) -> bool:
    if not series:
        return False
    figure, (axes,) = _figure(1)
    for k, (name, points) in enumerate(series.items()):
        _line(axes, points, COLOURS[k % len(COLOURS)], name)
    axes.set_yscale(scale)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=9, labelcolor=INK)
    _finish(axes, x_label, y_label)
    figure.savefig(path, facecolor="white")
    return True


def _figure(panels: int) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(9.6, 3.4), dpi=150, layout="constrained")
    return figure, list(figure.subplots(1, panels, squeeze=False)[0])


def _line(axes: Axes, points: Points, colour: str, label: str | None) -> None:
    x, y = zip(*points, strict=True)
    axes.plot(x, y, color=colour, linewidth=1.6, marker="o" if len(points) < 40 else None, markersize=3, label=label)


def _finish(axes: Axes, x_label: str, y_label: str) -> None:
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    style(axes, x_label, y_label)


def style(axes: Axes, x_label: str, y_label: str) -> None:
    """Set the labels and the style that all charts share."""
    axes.set_xlabel(x_label, color=INK)
    axes.set_ylabel(y_label, color=INK)
    axes.grid(color=FAINT, linewidth=0.7)
    axes.tick_params(colors=INK, labelsize=9)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(FAINT)

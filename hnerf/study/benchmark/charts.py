"""Charts of a benchmark. Methods differ in line style, marker and name as well as in colour, so that they can be told
apart in greyscale."""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from hnerf.evaluation.charts import COLOURS, INK, style
from hnerf.study.benchmark.curves import Point, bin_edges, bin_means, pareto_front

LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 3)))
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
PANEL_INCHES = (6.2, 3.5)
PANEL_HEIGHT_PT = 190  # typographic points from the lowest to the highest value of an axis
LABEL_GAP = 0.07  # between labels at line ends, as a share of a panel's height
LABEL_LIFT_PT = 7.0
CHARACTERS_PER_INCH = 13

Curves = Mapping[str, Sequence[Point]]
Style = dict[str, Any]
CLOUD: Style = {"linestyle": "none", "markersize": 3.5, "alpha": 0.35, "markeredgewidth": 0}
FRONT: Style = {"color": INK, "linewidth": 1.0, "linestyle": (0, (4, 3)), "zorder": 1, "scalex": False, "scaley": False}


@dataclass(frozen=True)
class SpeedRow:
    """One row of the speed chart. By method: curves (training seconds, accuracy), the reasons why they end, if known,
    and points (seconds per frame, accuracy). By title: the PSNR of trivial images."""

    curves: Curves
    end_reasons: Mapping[str, str]
    points: Mapping[str, Point]
    trivial_psnr: Mapping[str, float]


def styles(methods: Iterable[str]) -> dict[str, Style]:
    """Return a plot style for each method, the same in every chart of a study."""
    method_styles = zip(cycle(COLOURS), cycle(LINES), cycle(MARKERS), strict=False)
    return {
        name: {"color": colour, "linestyle": line, "marker": marker}
        for name, (colour, line, marker) in zip(methods, method_styles, strict=False)
    }


def speed_chart(
    rows: Mapping[str, SpeedRow],
    method_styles: Mapping[str, Style],
    labels: tuple[str, str, str],
    caption: str,
    path: Path,
) -> None:
    """Draw a row for each title: accuracy over training seconds, with lines for the accuracy of trivial images, and
    accuracy over seconds per frame, with its Pareto front. If there is a reason why a curve ends, it is written next to
    its name.

    labels: of training time, seconds per frame, accuracy.
    """
    figure, axes = _figure(len(rows), 2)
    for (left, right), (title, row) in zip(axes, rows.items(), strict=True):
        for panel in (left, right):
            panel.set_xscale("log")
        draw_curves(left, row.curves, method_styles, row.end_reasons)
        for name, height in row.trivial_psnr.items():
            left.axhline(height, color=INK, linewidth=0.8, linestyle=(0, (1, 2)), zorder=1)
            left.annotate(
                name, (0.01, height), (0, 3), ("axes fraction", "data"), "offset points", fontsize=8, color=INK
            )
        _decorate(left, title, labels[0], labels[2])
        draw_pareto_front(right, row.points, method_styles)
        _decorate(right, title, labels[1], labels[2])
        for panel in (left, right):
            _plain_numbers(panel)
    _save(figure, caption, path)


def sweep_chart(
    panels: Sequence[tuple[str, Curves]], method_styles: Mapping[str, Style], x_label: str, caption: str, path: Path
) -> None:
    """Draw a panel for each (label, curves): a score of the finished models over the number of cameras or frames, in
    which the variants of a study differ, on a logarithmic axis."""
    figure, axes = _figure(1, len(panels))
    for panel, (y_label, curves) in zip(axes[0], panels, strict=True):
        panel.set_xscale("log")
        draw_curves(panel, curves, method_styles)
        _decorate(panel, "", x_label, y_label)
        places = sorted({x for points in curves.values() for x, _ in points})
        panel.set_xticks(places, [f"{x:g}" for x in places])
        panel.xaxis.set_minor_locator(NullLocator())
    _save(figure, caption, path)


def training_distance_chart(
    panels: Sequence[tuple[str, Sequence[str], Curves]],
    method_styles: Mapping[str, Style],
    bins: int,
    caption: str,
    path: Path,
) -> None:
    """Draw a panel for each (title, labels of x and y, points by method): a mark for each image or surface, a line
    through the means of equally wide bins, and the number of points in each bin."""
    figure, axes = _figure(-(-len(panels) // 2), min(2, len(panels)))
    slots = [panel for row in axes for panel in row]
    for panel, (title, labels, clouds) in zip(slots, panels, strict=False):
        edges = bin_edges(clouds.values(), bins)
        means = {name: bin_means(points, edges) for name, points in clouds.items()}
        for name, points in clouds.items():
            panel.plot(*zip(*points, strict=True), **method_styles[name] | CLOUD)
        lines = {name: [(x, y) for x, y, _ in found.values()] for name, found in means.items()}
        draw_curves(panel, lines, method_styles)
        for x, _, count in max(means.values(), key=len).values():
            panel.annotate(f"n = {count}", (x, 0.01), xycoords=panel.get_xaxis_transform(), ha="center", fontsize=7)
        _decorate(panel, title, *labels)
    for panel in slots[len(panels) :]:
        panel.set_axis_off()
    _save(figure, caption, path)


def picture_grid(rows: Sequence[tuple[str, Sequence[tuple[str, Any]]]], caption: str, path: Path) -> None:
    """Draw the images (H, W, 3) uint8 of each row side by side, each under its name, with the row's title before the
    first."""
    columns = max(len(pictures) for _, pictures in rows)
    figure = Figure(figsize=(2.0 * columns + 0.4, 2.9 * len(rows) + 0.5), dpi=150, layout="constrained")
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for panel in axes.flat:
        panel.set_xticks([])
        panel.set_yticks([])
        panel.set_frame_on(False)
    for row, (title, pictures) in zip(axes, rows, strict=True):
        row[0].set_ylabel(title, color=INK, fontsize=8)
        for panel, (name, picture) in zip(row, pictures, strict=False):
            panel.imshow(picture)
            panel.set_title(name, color=INK, fontsize=9)
    _save(figure, caption, path)


def draw_curves(
    axes: Axes, curves: Curves, method_styles: Mapping[str, Style], end_reasons: Mapping[str, str] = {}
) -> None:
    """Draw a line per method, with its name at the end. If there is a reason why a line ends, write it next to the name
    and mark the end with a large marker and a bar."""
    drawn = {name: points for name, points in curves.items() if points}
    for name, points in drawn.items():
        axes.plot(*zip(*points, strict=True), linewidth=1.7, markersize=5, **method_styles[name])
        if name in end_reasons:
            axes.plot(*points[-1], "|", color=INK, markersize=22, markeredgewidth=1.6, zorder=3)
            axes.plot(*points[-1], **method_styles[name] | {"markersize": 9, "markeredgecolor": INK, "zorder": 4})
    _label_points({name: points[-1] for name, points in drawn.items()}, axes, method_styles, end_reasons=end_reasons)


def draw_pareto_front(axes: Axes, points: Mapping[str, Point], method_styles: Mapping[str, Style]) -> None:
    """Draw a mark per method and the Pareto front: a point to the right of it and below is beaten in both time and
    accuracy. Draw nothing if there are no points."""
    if not points:
        return
    for name, point in points.items():
        axes.plot(*point, **method_styles[name] | {"linestyle": "none", "markersize": 8})
    (_, right), (bottom, _) = axes.get_xlim(), axes.get_ylim()
    best = [points[name] for name in pareto_front(points)]
    corners = [(best[0][0], bottom), *best, (right, best[-1][1])]
    axes.plot(*zip(*corners, strict=True), label="Pareto front", drawstyle="steps-post", **FRONT)
    _label_points(points, axes, method_styles, LABEL_LIFT_PT)
    axes.legend(loc="best", frameon=False, fontsize=8, labelcolor=INK)


def _label_points(
    places: Mapping[str, Point],
    axes: Axes,
    method_styles: Mapping[str, Style],
    lift: float = 0.0,
    end_reasons: Mapping[str, str] = {},
) -> None:
    """Write names to the right of their points, with the reasons why their curves end. Labels are raised by `lift`
    typographic points, and further where they would overlap."""
    low, high = axes.get_ylim()
    free = low
    for name, (x, y) in sorted(places.items(), key=lambda place: place[1][1]):
        height = max(y, free)
        free = height + LABEL_GAP * (high - low)
        shift = (9, lift + (height - y) / (high - low) * PANEL_HEIGHT_PT)
        axes.annotate(
            f"{name}: {end_reasons[name]}" if name in end_reasons else name,
            (x, y),
            shift,
            textcoords="offset points",
            va="center",
            fontsize=9,
            color=method_styles[name]["color"],
            annotation_clip=False,
        )


def _figure(rows: int, columns: int) -> tuple[Figure, Any]:
    size = PANEL_INCHES[0] * columns, PANEL_INCHES[1] * rows + 0.5
    figure = Figure(figsize=size, dpi=130, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for panel in axes.flat:
        panel.margins(x=0.08, y=0.12)
    return figure, axes


def _decorate(axes: Axes, title: str, x_label: str, y_label: str) -> None:
    axes.set_title(title, color=INK, fontsize=10, loc="left")
    style(axes, x_label, y_label)


def _plain_numbers(axes: Axes) -> None:
    """Format a logarithmic x axis with plain numbers at 1, 2, 3, 5 and 7 of every decade, or at 1 and 3 if there are
    many decades."""
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0, 7.0) if high < 100 * low else (1.0, 3.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())


def _save(figure: Figure, caption: str, path: Path) -> None:
    figure.supxlabel(textwrap.fill(caption, int(CHARACTERS_PER_INCH * figure.get_figwidth())), fontsize=8, color=INK)
    figure.savefig(path, facecolor="white")

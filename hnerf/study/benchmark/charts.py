"""A benchmark's charts, which tell methods apart by line, marker and name, so that grey prints do, too."""

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
from hnerf.study.benchmark.curves import Point, bin_edges, binned, pareto_front

LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 3)))
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
PANEL_INCHES = (6.2, 3.5)
PANEL_POINTS = 190  # of those, from the lowest to the highest value that an axis shows
LABEL_GAP = 0.07  # of a panel's height, between names at line ends
ABOVE_LINE = 7.0  # points of type
CAPTION_LETTERS = 13  # on an inch

Curves = Mapping[str, Sequence[Point]]
Style = dict[str, Any]
NO_ENDS: Mapping[str, str] = {}


@dataclass(frozen=True)
class Speed:
    """What a row of the speed chart shows, by method: curves (training seconds, accuracy), why they end where that is
    known, points (time of a frame, accuracy); and the accuracy of what needs no training, by title."""

    curves: Curves
    ends: Mapping[str, str]
    points: Mapping[str, Point]
    trivial_psnr: Mapping[str, float]

    def __bool__(self) -> bool:
        return bool(self.curves or self.points)


def styles(methods: Iterable[str]) -> dict[str, Style]:
    """A look for each method, the same in every chart of a study."""
    looks = zip(cycle(COLOURS), cycle(LINES), cycle(MARKERS), strict=False)
    return {
        name: {"color": colour, "linestyle": line, "marker": marker}
        for name, (colour, line, marker) in zip(methods, looks, strict=False)
    }


def speed_chart(
    rows: Mapping[str, Speed],
    looks: Mapping[str, Style],
    labels: tuple[str, str, str],
    caption: str,
    path: Path,
) -> None:
    """A row for each title: accuracy over training seconds, above the accuracy of what needs no training, and over the
    time of a frame with its Pareto front. A curve whose end has a reason is named with it.

    labels: of training time, time of a frame, accuracy.
    """
    figure, axes = _figure(len(rows), 2)
    for (left, right), (title, row) in zip(axes, rows.items(), strict=True):
        for panel in (left, right):
            panel.set_xscale("log")
        lines(left, row.curves, looks, row.ends)
        for name, height in row.trivial_psnr.items():
            left.axhline(height, color=INK, linewidth=0.8, linestyle=(0, (1, 2)), zorder=1)
            left.annotate(
                name, (0.01, height), (0, 3), ("axes fraction", "data"), "offset points", fontsize=8, color=INK
            )
        _decorate(left, title, labels[0], labels[2])
        front(right, row.points, looks)
        _decorate(right, title, labels[1], labels[2])
        for panel in (left, right):
            _plain_numbers(panel)
    _save(figure, caption, path)


def sweep_chart(
    panels: Sequence[tuple[str, Curves]], looks: Mapping[str, Style], x_label: str, caption: str, path: Path
) -> None:
    """A panel for each (label, curves): a figure of the finished models over what the variants of a study differ in,
    each step of it as wide as the number grows by."""
    figure, axes = _figure(1, len(panels))
    for panel, (y_label, curves) in zip(axes[0], panels, strict=True):
        panel.set_xscale("log")
        lines(panel, curves, looks)
        _decorate(panel, "", x_label, y_label)
        places = sorted({x for points in curves.values() for x, _ in points})
        panel.set_xticks(places, [f"{x:g}" for x in places])
        panel.xaxis.set_minor_locator(NullLocator())
    _save(figure, caption, path)


def nearness_chart(
    panels: Sequence[tuple[str, Sequence[str], Curves]],
    looks: Mapping[str, Style],
    bins: int,
    caption: str,
    path: Path,
) -> None:
    """A panel for each (title, labels of x and y, points by method): every image or surface as a mark, means of bins of
    equal width as a line, and how many there are in a bin."""
    figure, axes = _figure(-(-len(panels) // 2), min(2, len(panels)))
    slots = [panel for row in axes for panel in row]
    for panel, (title, labels, clouds) in zip(slots, panels, strict=False):
        edges = bin_edges(clouds.values(), bins)
        means = {name: binned(points, edges) for name, points in clouds.items()}
        for name, points in clouds.items():
            look = looks[name] | {"linestyle": "none", "markersize": 3.5, "alpha": 0.35, "markeredgewidth": 0}
            panel.plot(*zip(*points, strict=True), **look)
        lines(panel, {name: [(x, y) for x, y, _ in found] for name, found in means.items()}, looks)
        for x, _, count in max(means.values(), key=len):
            panel.annotate(f"n = {count}", (x, 0.01), xycoords=panel.get_xaxis_transform(), ha="center", fontsize=7)
        _decorate(panel, title, *labels)
    for panel in slots[len(panels) :]:
        panel.set_axis_off()
    _save(figure, caption, path)


def picture_grid(rows: Sequence[tuple[str, Sequence[tuple[str, Any]]]], caption: str, path: Path) -> None:
    """Pictures (H, W, 3) uint8 of each row side by side, each under its name, the row's title before the first."""
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


def lines(axes: Axes, curves: Curves, looks: Mapping[str, Style], ends: Mapping[str, str] = NO_ENDS) -> None:
    """A line a method, its name at the line's end; where there is a reason why it ends, the reason beside the name and
    a large mark with a bar."""
    drawn = {name: points for name, points in curves.items() if points}
    for name, points in drawn.items():
        axes.plot(*zip(*points, strict=True), linewidth=1.7, markersize=5, **looks[name])
        if name in ends:
            axes.plot(*points[-1], "|", color=INK, markersize=22, markeredgewidth=1.6, zorder=3)
            axes.plot(*points[-1], **looks[name] | {"markersize": 9, "markeredgecolor": INK, "zorder": 4})
    _name({name: points[-1] for name, points in drawn.items()}, axes, looks, ends=ends)


def front(axes: Axes, points: Mapping[str, Point], looks: Mapping[str, Style]) -> None:
    """A mark a method, and the front: what lies right of it and below is beaten in both time and accuracy.
    Nothing where there is no point."""
    if not points:
        return
    for name, point in points.items():
        axes.plot(*point, **looks[name] | {"linestyle": "none", "markersize": 8})
    (_, right), (bottom, _) = axes.get_xlim(), axes.get_ylim()
    best = [points[name] for name in pareto_front(points)]
    corners = [(best[0][0], bottom), *best, (right, best[-1][1])]
    axes.plot(
        *zip(*corners, strict=True),
        color=INK,
        linewidth=1.0,
        linestyle=(0, (4, 3)),
        zorder=1,
        drawstyle="steps-post",
        label="Pareto front",
        scalex=False,
        scaley=False,
    )
    _name(points, axes, looks, ABOVE_LINE)
    axes.legend(loc="best", frameon=False, fontsize=8, labelcolor=INK)


def _name(
    places: Mapping[str, Point],
    axes: Axes,
    looks: Mapping[str, Style],
    lift: float = 0.0,
    ends: Mapping[str, str] = NO_ENDS,
) -> None:
    """Names right of their places, each with its end's reason, lifted by points of type, and more where they would lie
    upon each other."""
    low, high = axes.get_ylim()
    free = low
    for name, (x, y) in sorted(places.items(), key=lambda place: place[1][1]):
        height = max(y, free)
        free = height + LABEL_GAP * (high - low)
        shift = (9, lift + (height - y) / (high - low) * PANEL_POINTS)
        axes.annotate(
            f"{name}: {ends[name]}" if name in ends else name,
            (x, y),
            shift,
            textcoords="offset points",
            va="center",
            fontsize=9,
            color=looks[name]["color"],
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
    """A logarithmic x axis with plain numbers at 1, 2, 3, 5 and 7 of every decade, at 1 and 3 where there are many."""
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0, 7.0) if high < 100 * low else (1.0, 3.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())


def _save(figure: Figure, caption: str, path: Path) -> None:
    figure.supxlabel(textwrap.fill(caption, int(CAPTION_LETTERS * figure.get_figwidth())), fontsize=8, color=INK)
    figure.savefig(path, facecolor="white")

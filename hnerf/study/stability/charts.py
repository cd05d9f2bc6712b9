"""Charts of a stability study, as PNG files that are readable in greyscale."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from hnerf.evaluation.charts import FAINT, INK, style
from hnerf.study.benchmark.charts import Style, styles
from hnerf.study.degradations.catalogue import KINDS
from hnerf.study.stability.report import REFERENCE, Row, worst_run

SHADES = {"ok": "#e8f1ec", "degraded": "#f2c877", "refused": "#9dbbdc", "failed": "#a3293d", "unscored": "#949494"}
LETTERS = {"ok": "o", "degraded": "D", "refused": "R", "failed": "F", "unscored": "?"}
LABELS = {"psnr": "PSNR, dB", "chamfer_mm": "Chamfer distance, mm"}
CAPTION = "line: mean over seeds; band: range; dotted: reference, same images or surfaces; cross: no score"
COLUMNS = 4  # of panels, maximum
CELL, GAP = (0.52, 0.42), 0.4  # size of a matrix cell in inches; gap between methods in cells
LEFT, BOTTOM, LEGEND = 2.7, 0.4, 6.2  # inches


def matrix_chart(result: Row, path: Path) -> None:
    """Draw a row for each degradation and a block of columns for each method. Each strength, the mildest on the left,
    gets a letter and a shade for the worst verdict over seeds."""
    methods, kinds = result["plan"]["methods"], result["plan"]["degradations"]
    wide = max(map(len, kinds.values()))
    across, down = len(methods) * (wide + GAP) - GAP, len(kinds) + 0.6  # in cells
    width, height = max(LEFT + across * CELL[0] + 0.2, LEGEND), down * CELL[1] + BOTTOM
    figure = Figure(figsize=(width, height), dpi=150)
    axes = figure.add_axes((LEFT / width, BOTTOM / height, across * CELL[0] / width, down * CELL[1] / height))
    for column, method in enumerate(methods):
        left = column * (wide + GAP)
        axes.text(left + wide / 2, -0.25, method, ha="center", fontsize=10, fontweight="bold", color=INK)
        for row, (kind, strengths) in enumerate(kinds.items()):
            for k, strength in enumerate(strengths):
                _cell(axes, left + k, row, strength, worst_run(result, method, kind, strength))
    axes.set_xlim(0, across)
    axes.set_ylim(len(kinds), -0.6)
    axes.set_yticks(np.arange(len(kinds)) + 0.5, [KINDS[kind].label for kind in kinds], color=INK, fontsize=9)
    axes.set_xticks([])
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    patches = [Patch(facecolor=SHADES[w], edgecolor=INK, label=f"{LETTERS[w]}  {w}") for w in SHADES]
    figure.legend(handles=patches, loc="lower right", ncols=len(SHADES), frameon=False, fontsize=9, labelcolor=INK)
    figure.savefig(path, facecolor="white")


def curve_chart(result: Row, key: str, path: Path) -> bool:
    """Draw a panel for each degradation: a score of every method over strength, starting from the capture as recorded.
    Lines are means and bands are ranges over seeds; the dotted line is the reference over the same images or surfaces;
    a cross marks a seed without a score. Return whether there was a score to draw, so that the file was written."""
    measured = {run["kind"] for run in result["runs"] if run.get(key) is not None} - {REFERENCE}
    kinds = {kind: strengths for kind, strengths in result["plan"]["degradations"].items() if kind in measured}
    if not kinds:
        return False
    columns = min(COLUMNS, len(kinds))
    rows = math.ceil(len(kinds) / columns)
    size = max(3.2 * columns, LEGEND), 2.5 * rows + 0.6
    figure = Figure(figsize=size, dpi=150, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for axes in grid.flat[len(kinds) :]:
        axes.set_visible(False)
    for axes, (kind, strengths) in zip(grid.flat, kinds.items(), strict=False):
        for k, (method, method_style) in enumerate(styles(result["plan"]["methods"]).items()):
            _curve(axes, [r for r in result["runs"] if r["method"] == method], kind, strengths, key, method_style, k)
        axes.set_xticks(range(len(strengths) + 1), ["none", *(f"{s:g}" for s in strengths)])
        axes.set_xlim(-0.3, len(strengths) + 0.3)
        style(axes, KINDS[kind].label, "")
    for axes in grid[:, 0]:
        axes.set_ylabel(LABELS[key], color=INK)
    handles, labels = grid.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=len(labels), frameon=False, labelcolor=INK)
    figure.supxlabel(CAPTION, fontsize=7, color=INK)
    figure.savefig(path, facecolor="white")
    return True


def _cell(axes: Axes, x: float, y: float, strength: float, run: Row | None) -> None:
    colour = SHADES[run["verdict"]] if run else "white"
    axes.add_patch(Rectangle((x + 0.03, y + 0.06), 0.94, 0.88, facecolor=colour, edgecolor=FAINT, linewidth=0.7))
    ink = "white" if run and run["verdict"] == "failed" else INK
    letter = LETTERS[run["verdict"]] if run else ""
    axes.text(x + 0.5, y + 0.36, letter, ha="center", va="center", fontsize=10, fontweight="bold", color=ink)
    axes.text(x + 0.5, y + 0.74, f"{strength:g}", ha="center", va="center", fontsize=6.5, color=ink)


def _curve(
    axes: Axes, runs: list[Row], kind: str, strengths: list[float], key: str, method_style: Style, k: int
) -> None:
    """Draw one method's line in a panel; k is the method's index."""
    by_place = [[r for r in runs if r["kind"] == REFERENCE]]
    by_place += [[r for r in runs if r["kind"] == kind and r["strength"] == strength] for strength in strengths]
    values: list[Any] = [[r[key] for r in place if r.get(key) is not None] for place in by_place]
    good: list[Any] = [[r["reference"][key] for r in place if r.get(key) is not None] for place in by_place]
    x = [place for place, found in enumerate(values) if found]
    axes.plot(x, [np.mean(good[place]) for place in x], ":", color=method_style["color"], linewidth=1.0)
    means, lows, highs = ([f(values[place]) for place in x] for f in (np.mean, min, max))
    axes.plot(x, means, linewidth=1.6, markersize=4, label=runs[0]["method"] if runs else None, **method_style)
    axes.fill_between(x, lows, highs, color=method_style["color"], alpha=0.2, linewidth=0)
    gone = [place for place, found in enumerate(by_place) if len(found) > len(values[place])]
    cross: Style = {"color": method_style["color"], "markersize": 7, "markeredgewidth": 2}
    axes.plot([x + 0.15 * k for x in gone], [0.04] * len(gone), "x", transform=axes.get_xaxis_transform(), **cross)

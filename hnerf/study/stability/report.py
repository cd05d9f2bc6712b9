"""Tables of a stability study, in Markdown.

Runs are plain rows: method, seed, kind, strength, verdict, reason, and scores if there are any.
"""

import itertools
from collections.abc import Sequence
from typing import Any

from hnerf.files import markdown_image
from hnerf.study.degradations.catalogue import KINDS
from hnerf.study.stability.verdict import (
    BROKEN,
    DEGRADED_DB,
    DEGRADED_RATIO,
    FAILED_DB,
    FAILED_RATIO,
    FAILED_SHARE,
    WORST_LAST,
)
from hnerf.study.surface import LENGTH_RANGE, VOLUME_RANGE
from hnerf.tables import shown, table

REFERENCE = "as recorded"
LEGEND = (
    f"**ok**: at most {DEGRADED_DB:g} dB less PSNR than the same method and seed on the capture as recorded, and at "
    f"most {DEGRADED_RATIO:g} times its Chamfer distance. **degraded**: worse than that. **failed**: over "
    f"{FAILED_DB:g} dB less, or over {FAILED_SHARE:g} of what the reference has above an empty picture, or over "
    f"{FAILED_RATIO:g} times the distance; pictures no better than empty ones; a crash; no surface, or one that is not"
    f" watertight or not of the body's size (volume {VOLUME_RANGE[0]:g} to {VOLUME_RANGE[1]:g}, length "
    f"{LENGTH_RANGE[0]:g} to {LENGTH_RANGE[1]:g} of it). **refused**: an earlier stage or the training reported what "
    "is wrong with the input. **unscored**: no image or surface with ground truth is in both runs; extreme poses are "
    "judged by surfaces alone. Scores are of novel poses from test cameras, which no degradation changes, except that"
    " they and the ground truth also wear the skirt or the hair. Poses are animated, as fitted before training; if "
    "the degradation is of the fit itself, as fitted without it. Beside them is the PSNR of the same images posed and"
    " tracked. Training poses are scored if the capture or the method has no novel ones. Runs, and the differences in"
    " parentheses, are compared over the images and surfaces that both have: a frame that a degradation removes "
    "counts in neither. Without test cameras images are not compared. A surface is the largest component of the mesh;"
    " detached parts do not count. A method **holds to** the strongest strength up to which the worst seed is ok at "
    "every strength."
)

FIGURES = {  # title and digits, by key in a run
    "psnr": ("PSNR, dB", 2),
    "posed_psnr": ("posed, dB", 2),
    "tracked_psnr": ("tracked, dB", 2),
    "ssim": ("SSIM", 3),
    "chamfer_mm": ("Chamfer, mm", 2),
}

Row = dict[str, Any]


def worst_run(result: Row, method: str, kind: str, strength: float) -> Row | None:
    """Return the worst run over seeds, or None if there is none yet. If every reference run of the method is broken,
    the reference runs count as well."""
    found = [r for r in result["runs"] if r["method"] == method and r["kind"] == kind and r["strength"] == strength]
    good = [r for r in result["runs"] if r["method"] == method and r["kind"] == REFERENCE]
    if all(r["verdict"] in BROKEN for r in good):
        found += good
    return max(found, key=lambda r: WORST_LAST.index(r["verdict"]), default=None)


def tolerated_strength(result: Row, method: str, kind: str) -> str:
    """Return the strongest strength up to which the worst seed is ok at every strength, the first strength at which a
    seed is degraded, and the first at which one fails or is refused, as far as there are any."""
    strengths = result["plan"]["degradations"][kind]
    runs = [(f"{s:g}", run["verdict"]) for s in strengths if (run := worst_run(result, method, kind, s))]
    held = [strength for strength, _ in itertools.takewhile(lambda run: run[1] == "ok", runs)]
    parts = [f"holds to {held[-1]}"] if held else []
    for verdicts in (("degraded",), BROKEN):
        parts += [f"{verdict} at {strength}" for strength, verdict in runs if verdict in verdicts][:1]
    return ", ".join(parts) or ("unscored" if runs else "-")


def as_markdown(result: Row, charts: Sequence[str]) -> str:
    """Format the whole result: how far each method holds, charts, every run, what was left out, and the meaning of
    verdicts."""
    methods, kinds = result["plan"]["methods"], result["plan"]["degradations"]
    lines = [f"# Stability of {', '.join(methods)} on {result['subject']}: study `{result['study']}`", "", LEGEND, ""]
    held = [[KINDS[kind].label, *(tolerated_strength(result, method, kind) for method in methods)] for kind in kinds]
    lines += ["## How far each method holds", "", *table([["degradation", *methods], *held])]
    titles = ["method", "degradation", "strength", "seed", "verdict", *(title for title, _ in FIGURES.values())]
    runs = table([titles, *map(_cells, result["runs"])])
    lines += ["", *map(markdown_image, charts), "", "## Runs", "", *runs]
    lines += ["", "## Left out", "", *(f"- {reason}" for reason in result["left_out"] or ["nothing"]), ""]
    return "\n".join([*lines, *([result["protocol"], ""] if result["protocol"] else [])])


def _cells(run: Row) -> list[str]:
    kind = KINDS[run["kind"]].label if run["kind"] in KINDS else run["kind"]
    strength = "" if run["strength"] is None else f"{run['strength']:g}"
    verdict = f"{run['verdict']}: {run['reason']}" if run["reason"] else run["verdict"]
    scores = [_compared(run, key, digits) for key, (_, digits) in FIGURES.items()]
    return [run["method"], kind, strength, str(run["seed"]), verdict, *scores]


def _compared(run: Row, key: str, digits: int) -> str:
    """Return a score and, for a degraded run, its difference from the reference over the same images or surfaces."""
    value = run.get(key)
    if value is None or run["kind"] == REFERENCE:
        return shown(value, f"{{:.{digits}f}}")
    return f"{value:.{digits}f} ({value - run['reference'][key]:+.{digits}f})"

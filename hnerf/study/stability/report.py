"""Tables of a stability study, in Markdown.

Runs are plain rows: method, seed, kind, strength, verdict, reason, and figures where there are any.
"""

import itertools
from collections.abc import Sequence
from typing import Any

from hnerf.files import picture
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
from hnerf.tables import head, line, shown

REFERENCE = "as recorded"
LEGEND = (
    f"**ok**: at most {DEGRADED_DB:g} dB of PSNR lost against the same method and seed on the capture as recorded, and "
    f"a Chamfer distance of at most {DEGRADED_RATIO:g} times that. **degraded**: worse. **failed**: over {FAILED_DB:g} "
    f"dB, or {FAILED_SHARE:g} of what that run has above an empty picture, or {FAILED_RATIO:g} times the distance; "
    "pictures no better than empty ones, a crash, no surface, one that is not watertight or not of the body's size "
    f"(volume {VOLUME_RANGE[0]:g} to {VOLUME_RANGE[1]:g}, length {LENGTH_RANGE[0]:g} to {LENGTH_RANGE[1]:g} of it). **refused**: an "
    "earlier stage or the training said what is wrong with the input. **unscored**: nothing is known to be true of the "
    "images and surfaces that both runs show, so that neither good nor bad can be told; extreme poses are judged by "
    "surfaces alone. Novel poses from test cameras are scored, which no degradation touches, but that they and the "
    "truth wear the skirt or the hair, too. They are animated: in poses as fitted before training, and where a "
    "degradation is of the fit itself, as fitted without it; PSNR of the same images posed and tracked stands beside. "
    "Training poses are scored where the capture or the method has no others. Runs are compared by the images and "
    "surfaces that both have, and so are the differences in parentheses: a frame that a degradation took away counts "
    "in neither. Without test cameras images are not compared. A surface is the largest component that meshing finds; "
    "what floats beside it does not count. A method **holds to** the strongest strength up to which the worst seed of "
    "every one is ok."
)

FIGURES = {  # title and digits of a run's
    "psnr": ("PSNR, dB", 2),
    "posed_psnr": ("posed, dB", 2),
    "tracked_psnr": ("tracked, dB", 2),
    "ssim": ("SSIM", 3),
    "chamfer_mm": ("Chamfer, mm", 2),
}

Row = dict[str, Any]


def worst(result: Row, method: str, kind: str, strength: float) -> Row | None:
    """The worst run over seeds, None where there is none yet. Where no seed has a good run to compare with, these runs
    stand for all."""
    found = [r for r in result["runs"] if r["method"] == method and r["kind"] == kind and r["strength"] == strength]
    good = [r for r in result["runs"] if r["method"] == method and r["kind"] == REFERENCE]
    if all(r["verdict"] in BROKEN for r in good):
        found += good
    return max(found, key=lambda r: WORST_LAST.index(r["verdict"]), default=None)


def how_far(result: Row, method: str, kind: str) -> str:
    """The strongest strength up to which the worst seed of each is ok, the first at which it is degraded, and the first
    at which it fails or is refused, as far as there are such."""
    strengths = result["plan"]["degradations"][kind]
    runs = [(f"{s:g}", run["verdict"]) for s in strengths if (run := worst(result, method, kind, s))]
    held = [strength for strength, _ in itertools.takewhile(lambda run: run[1] == "ok", runs)]
    message = [f"holds to {held[-1]}"] if held else []
    for words in (("degraded",), BROKEN):
        message += [f"{verdict} at {strength}" for strength, verdict in runs if verdict in words][:1]
    return ", ".join(message) or ("unscored" if runs else "-")


def as_markdown(result: Row, charts: Sequence[str]) -> str:
    """How far each method holds, charts, every run, what was left out, and what verdicts mean."""
    methods, kinds = result["plan"]["methods"], result["plan"]["degradations"]
    lines = [f"# Stability of {', '.join(methods)} on {result['subject']}: study `{result['study']}`", "", LEGEND, ""]
    lines += ["## How far each method holds", "", *head(["degradation", *methods])]
    for kind in kinds:
        lines.append(line([KINDS[kind].label, *(how_far(result, method, kind) for method in methods)]))
    lines += ["", *map(picture, charts), "", "## Runs", ""]
    lines += head(["method", "degradation", "strength", "seed", "verdict", *(title for title, _ in FIGURES.values())])
    lines += [line(_cells(run)) for run in result["runs"]]
    lines += ["", "## Left out", "", *(f"- {reason}" for reason in result["left_out"] or ["nothing"]), ""]
    return "\n".join([*lines, *([result["protocol"], ""] if result["protocol"] else [])])


def _cells(run: Row) -> list[str]:
    kind = KINDS[run["kind"]].label if run["kind"] in KINDS else run["kind"]
    strength = "" if run["strength"] is None else f"{run['strength']:g}"
    verdict = f"{run['verdict']}: {run['reason']}" if run["reason"] else run["verdict"]
    scores = [_compared(run, key, digits) for key, (_, digits) in FIGURES.items()]
    return [run["method"], kind, strength, str(run["seed"]), verdict.replace("|", "/"), *scores]


def _compared(run: Row, key: str, digits: int) -> str:
    """A figure and, of a degraded run, how much it differs from the reference over the same images or surfaces."""
    value = run.get(key)
    if value is None or run["kind"] == REFERENCE:
        return shown(value, f"{{:.{digits}f}}")
    return f"{value:.{digits}f} ({value - run['reference'][key]:+.{digits}f})"

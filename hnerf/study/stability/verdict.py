"""Verdict on a run under a degradation, by comparison with the same run on the capture as recorded."""

from dataclasses import dataclass
from typing import Any, Literal

Verdict = Literal["ok", "unscored", "degraded", "refused", "failed"]
WORST_LAST: tuple[Verdict, ...] = ("ok", "unscored", "degraded", "refused", "failed")
BROKEN: tuple[Verdict, ...] = ("refused", "failed")

# 1 dB is a quarter more squared error, visible only side by side; 6 dB is four times as much.
DEGRADED_DB, FAILED_DB = 1.0, 6.0
FAILED_SHARE = 0.5  # of a good run's PSNR above that of an empty image, if that is less than 6 dB
# Likewise a quarter more distance; at three times a good run's distance, parts of the body are in the wrong place.
DEGRADED_RATIO, FAILED_RATIO = 1.25, 3.0
BORDER_SHARE = 0.2  # share of the allowed loss around a border within which another seed could change the verdict


@dataclass(frozen=True)
class RunVerdict:
    """A verdict. reason: one line, empty if the verdict is ok."""

    verdict: Verdict
    reason: str = ""


def judge(
    scores: dict[str, Any] | None, reference: dict[str, Any], faults: list[str], leniency: float = 1.0
) -> RunVerdict:
    """Judge a degraded run by its scores and those of its reference.

    `scores` and `reference` hold psnr (dB) and chamfer_mm of the same images and surfaces, degraded and not, or None
    where there is no ground truth; `reference` also holds empty_psnr, that of an empty image. `scores` is None if only
    surfaces are judged. faults: what is wrong with surfaces; any fault is a failure, whatever the scores. leniency:
    factor on the allowed losses, in dB and in distance.
    """
    if faults:
        return RunVerdict("failed", faults[0])
    if scores is None:
        return RunVerdict("ok")
    findings: list[tuple[Verdict, str]] = []
    if None not in (scores["psnr"], reference["psnr"]):
        if scores["psnr"] <= reference["empty_psnr"]:
            return RunVerdict("failed", "pictures are no better than empty ones")
        lost_db, above_db = reference["psnr"] - scores["psnr"], reference["psnr"] - reference["empty_psnr"]
        failed_db = min(FAILED_DB, FAILED_SHARE * above_db)
        findings.append(
            (_classify(lost_db, leniency * DEGRADED_DB, leniency * failed_db), f"{lost_db:.1f} dB of PSNR lost")
        )
    if None not in (scores["chamfer_mm"], reference["chamfer_mm"]):
        ratio = scores["chamfer_mm"] / reference["chamfer_mm"]
        borders = (1 + leniency * (border - 1) for border in (DEGRADED_RATIO, FAILED_RATIO))
        findings.append((_classify(ratio, *borders), f"Chamfer distance times {ratio:.2f}"))
    if not findings:
        return RunVerdict("unscored", "no image or surface is scored in both runs")
    worst = max((verdict for verdict, _ in findings), key=WORST_LAST.index)
    return RunVerdict(worst, "; ".join(reason for verdict, reason in findings if verdict == worst and verdict != "ok"))


def near_border(scores: dict[str, Any] | None, reference: dict[str, Any], faults: list[str]) -> bool:
    """Return whether the verdict would change if the allowed losses were a fifth smaller or larger."""
    strict, lenient = (judge(scores, reference, faults, leniency) for leniency in (1 - BORDER_SHARE, 1 + BORDER_SHARE))
    return strict.verdict != lenient.verdict


def _classify(value: float, degraded: float, failed: float) -> Verdict:
    """Classify a loss. NaN is a failure, and so is a value above `failed`, even if it is below `degraded`."""
    return "failed" if not value <= failed else "degraded" if value > degraded else "ok"

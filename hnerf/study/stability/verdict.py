"""What came of a run under bad conditions, next to the same run under good ones."""

from dataclasses import dataclass
from typing import Any, Literal

Word = Literal["ok", "unscored", "degraded", "refused", "failed"]
WORST_LAST: tuple[Word, ...] = ("ok", "unscored", "degraded", "refused", "failed")
BROKEN: tuple[Word, ...] = ("refused", "failed")

# 1 dB is a quarter more squared error, seen side by side and hardly otherwise; 6 dB is four times as much.
DEGRADED_DB, FAILED_DB = 1.0, 6.0
FAILED_SHARE = 0.5  # of what a good run has above an empty picture, where that is less than 6 dB
# A quarter more distance, too; at three times the distance of a good run, parts of the body lie elsewhere.
DEGRADED_RATIO, FAILED_RATIO = 1.25, 3.0
NEAR = 0.2  # share of a border, of what may be lost, within which another seed could tell otherwise


@dataclass(frozen=True)
class RunVerdict:
    """reason: one line, empty where it is ok."""

    word: Word
    reason: str = ""


def judge(
    scores: dict[str, Any] | None, reference: dict[str, Any], faults: list[str], leniency: float = 1.0
) -> RunVerdict:
    """`scores` and `reference` hold psnr (dB) and chamfer_mm of the same images and surfaces, degraded and not, or None
    where there is no truth, `reference` also empty_psnr, of an empty picture; `scores` is None where surfaces alone are
    judged. faults: what is wrong with surfaces, which is failure whatever the scores. leniency: share of what may be
    lost, in dB and in distance, that may be lost here."""
    if faults:
        return RunVerdict("failed", faults[0])
    if scores is None:
        return RunVerdict("ok")
    words: list[tuple[Word, str]] = []
    if None not in (scores["psnr"], reference["psnr"]):
        if scores["psnr"] <= reference["empty_psnr"]:
            return RunVerdict("failed", "pictures are no better than empty ones")
        lost_db, above_db = reference["psnr"] - scores["psnr"], reference["psnr"] - reference["empty_psnr"]
        failed_db = min(FAILED_DB, FAILED_SHARE * above_db)
        words.append((_word(lost_db, leniency * DEGRADED_DB, leniency * failed_db), f"{lost_db:.1f} dB of PSNR lost"))
    if None not in (scores["chamfer_mm"], reference["chamfer_mm"]):
        ratio = scores["chamfer_mm"] / reference["chamfer_mm"]
        borders = (1 + leniency * (border - 1) for border in (DEGRADED_RATIO, FAILED_RATIO))
        words.append((_word(ratio, *borders), f"Chamfer distance times {ratio:.2f}"))
    if not words:
        return RunVerdict("unscored", "no image or surface is scored in both runs")
    worst = max((word for word, _ in words), key=WORST_LAST.index)
    return RunVerdict(worst, "; ".join(reason for word, reason in words if word == worst and word != "ok"))


def near_border(scores: dict[str, Any] | None, reference: dict[str, Any], faults: list[str]) -> bool:
    """Whether the verdict would be another if a fifth more, or less, might be lost."""
    strict, lenient = (judge(scores, reference, faults, leniency) for leniency in (1 - NEAR, 1 + NEAR))
    return strict.word != lenient.word


def _word(value: float, degraded: float, failed: float) -> Word:
    """NaN is a failure; so is what is over `failed`, though that be less than `degraded`."""
    return "failed" if not value <= failed else "degraded" if value > degraded else "ok"

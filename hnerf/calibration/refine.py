"""Refinement of cameras, accepted only if held-out frames and joints prove it and the images do not contradict it."""

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hnerf.calibration.bundle import adjust
from hnerf.calibration.diagnosis import held_out_parts, measure, trimmed_cost_px
from hnerf.calibration.evidence import Evidence
from hnerf.calibration.matches import Matches
from hnerf.calibration.outline_adjustment import FRAMES, follow_outlines
from hnerf.calibration.silhouettes import Outlines
from hnerf.calibration.sizes import SIZE_CHANGES, size_unexplained
from hnerf.capture.capture import Capture
from hnerf.config import CalibrationSettings
from hnerf.geometry.camera import Camera

OUTLINE_NOISE, OUTLINE_NOISE_PX = 0.05, 0.05  # share, or pixels, by which outlines may fit worse by chance
MATCH_NOISE_PX = 0.5  # pixels by which the matches of two cameras may fit worse by chance

log = logging.getLogger("hnerf.calibration")


@dataclass(frozen=True)
class Refinement:
    """Result of a refinement: the cameras to use, the costs in pixels of everything tried (on held-out frames, and of
    outlines), and the reasons, per camera and for the rig."""

    cameras: list[Camera]
    held_out_px: dict[str, float]
    outlines_px: dict[str, float]
    reasons: dict[str, str]
    notes: list[str]


@dataclass(frozen=True)
class _Candidate:
    """Candidate cameras, their changes by camera name, and their cost on held-out frames."""

    cameras: list[Camera]
    changes: dict[str, str]
    cost_px: float


def refine(evidence: Evidence, cameras: list[Camera], settings: CalibrationSettings) -> Refinement:
    """Adjust the cameras that do not fit the others. The given `cameras` themselves are returned unless held-out frames
    improve.

    Cameras are freed one by one with the others fixed; all are freed together if more than one needs it or residuals
    stay too large. A change that the image matches of two cameras contradict is not accepted.
    """
    capture, keypoints, outlines, matches = evidence.capture, evidence.keypoints, evidence.outlines, evidence.matches
    cost_factor = 1 - settings.min_improvement
    held_out_px = {"as given": held_out_cost_px(cameras, keypoints, ())}
    chosen, kept = _refine_one_by_one(cameras, keypoints, matches, cost_factor, held_out_px)
    too_large = max(measure(chosen.cameras, keypoints).median_px.values()) > settings.max_residual_px
    if len(chosen.changes) > 1 or too_large:
        together = _refine_together(cameras, keypoints, held_out_px)
        better = together.cost_px < cost_factor * chosen.cost_px
        chosen = together if better and not _contradiction(matches, cameras, together.cameras) else chosen
    if not chosen.changes:
        notes = ["refinement did not improve held-out frames: the cameras are used as given"] if too_large else []
        return Refinement(cameras, held_out_px, {}, kept, notes)
    free = tuple(chosen.changes)
    refined, notes = _refine_for_size(
        capture, chosen.cameras, keypoints, free, cost_factor * chosen.cost_px, held_out_px
    )
    if refined is not chosen.cameras:
        refined = adjust(refined, keypoints, free)
    points_m = measure(refined, keypoints).points_m
    more = Outlines.of(capture, FRAMES) if outlines else None
    followed, gain = follow_outlines(more, refined, free, points_m, settings.min_improvement)
    if gain and not _contradiction(matches, cameras, followed):
        changes = {name: f"{before}; then {gain}" for name, before in chosen.changes.items()}
        refined, chosen = followed, dataclasses.replace(chosen, changes=changes)
    gained = 1 - chosen.cost_px / held_out_px["as given"]
    outlines_px, refusal = judge_by_outlines(outlines, cameras, refined, gained)
    if refusal:
        return Refinement(cameras, held_out_px, outlines_px, kept, [refusal])
    return Refinement(refined, held_out_px, outlines_px, kept | chosen.changes, notes)


def _refine_one_by_one(
    cameras: list[Camera], keypoints: np.ndarray, matches: Matches, cost_factor: float, held_out_px: dict[str, float]
) -> tuple[_Candidate, dict[str, str]]:
    """Free the camera that improves held-out frames most, then one more, until two fixed cameras are left or none
    improves enough.

    Adds the cost of everything tried to `held_out_px`; also returns the reasons why the other cameras stay as they are.
    """
    kept = {camera.name: "pose kept: refining it needs two other cameras" for camera in cameras}
    cost_px, changes, zoomed = held_out_px["as given"], dict[str, str](), tuple[str, ...]()
    for _ in cameras[2:]:
        tried = {}
        for name in (camera.name for camera in cameras if camera.name not in changes):
            what = f"pose of {' and '.join([*changes, name])} refined"
            log.info("trying: %s", what)
            tried[name] = held_out_px[what] = held_out_cost_px(cameras, keypoints, (*changes, name), zoomed)
            kept[name] = f"pose kept: refining it takes held-out frames {_from_to(cost_px, tried[name])}"
            if matches.by_pair and (  # without matches, nothing could contradict
                against := _contradiction(matches, cameras, adjust(cameras, keypoints, (*changes, name), zoomed))
            ):
                kept[name] += f", but {against}"
                del tried[name]
        name = min(tried, key=tried.__getitem__, default="")
        if not name or tried[name] >= cost_factor * cost_px:
            break
        what = f"pose of {' and '.join([*changes, name])} and focal length of {name} refined"
        held_out_px[what] = held_out_cost_px(cameras, keypoints, (*changes, name), (*zoomed, name))
        focal = held_out_px[what] < cost_factor * tried[name]
        gained_px = held_out_px[what] if focal else tried[name]
        changes[name] = f"pose {'and focal length ' * focal}refined: held-out frames go {_from_to(cost_px, gained_px)}"
        cost_px, zoomed = gained_px, (*zoomed, name) if focal else zoomed
    adjusted = adjust(cameras, keypoints, tuple(changes), zoomed) if changes else cameras
    return _Candidate(adjusted, changes, cost_px), kept


def _refine_together(cameras: list[Camera], keypoints: np.ndarray, held_out_px: dict[str, float]) -> _Candidate:
    """Refine all poses together and add the cost to `held_out_px`."""
    log.info("trying: all poses refined")
    everyone = tuple(camera.name for camera in cameras)
    cost_px = held_out_px["all poses refined"] = held_out_cost_px(cameras, keypoints, everyone)
    changes = f"refined with all others: held-out frames go {_from_to(held_out_px['as given'], cost_px)}"
    return _Candidate(adjust(cameras, keypoints, everyone), dict.fromkeys(everyone, changes), cost_px)


def _contradiction(matches: Matches, given: list[Camera], refined: list[Camera]) -> str:
    """Return which pair's matches contradict the refinement, in words; empty if none does."""
    before_px, after_px = matches.residuals_px(given), matches.residuals_px(refined)
    for (a, b), px in after_px.items():
        was_px, is_px = float(np.median(before_px[a, b])), float(np.median(px))
        if is_px > was_px + MATCH_NOISE_PX:
            return f"matches of {a} and {b} go {_from_to(was_px, is_px)}"
    return ""


def _from_to(before_px: float, after_px: float) -> str:
    return f"from {before_px:.2f} to {after_px:.2f} px"


def judge_by_outlines(
    outlines: Outlines | None, given: list[Camera], refined: list[Camera], gained: float
) -> tuple[dict[str, float], str]:
    """Return the cost of the person's outlines before and after, and why it rules out the refinement (empty if it does
    not).

    Outlines may fit worse by chance, but by no larger share than keypoints gained: a detector that misplaces a joint in
    the same way in all frames moves a camera to gain a few hundredths of its residual.
    """
    if outlines is None:
        return {}, ""
    costs_px = {"as given": outlines.cost_px(given), "refined": outlines.cost_px(refined)}
    before_px, after_px = costs_px.values()
    if after_px <= before_px + min(gained * before_px, max(OUTLINE_NOISE_PX, OUTLINE_NOISE * before_px)):
        return costs_px, ""
    worse = _from_to(before_px, after_px)
    return costs_px, f"refinement refused: keypoints gain by it, but the person's outlines fit worse, {worse}"


def _refine_for_size(
    capture: Capture,
    cameras: list[Camera],
    keypoints: np.ndarray,
    free: Sequence[str],
    must_beat_px: float,
    held_out_px: dict[str, float],
) -> tuple[list[Camera], list[str]]:
    """Try intrinsics that explain recorded sizes that differ from the calibrated ones without black bars. Return the
    cameras, with those intrinsics if held-out frames prove them, and notes.

    Adds the costs of what was tried to `held_out_px`.
    """
    doubtful = [c.name for c in cameras if size_unexplained(capture, c.name)]
    if not doubtful:
        return cameras, []
    sizes = {name: (capture.calibrated_sizes_px[name], capture.recorded_sizes_px[name]) for name in doubtful}
    tried = {}
    for what, change in SIZE_CHANGES.items():
        log.info("trying: pictures were %s", what)
        tried[what] = [change(c, *sizes[c.name]) if c.name in sizes else c for c in cameras]
        held_out_px[f"and pictures {what}"] = held_out_cost_px(tried[what], keypoints, free)
    best = min(tried, key=lambda what: held_out_px[f"and pictures {what}"])
    if held_out_px[f"and pictures {best}"] >= must_beat_px:
        return cameras, ["what changed the picture size cannot be told from keypoints: intrinsics as given"]
    return tried[best], [f"pictures of another size than calibrated were {best}: intrinsics changed to match"]


def held_out_cost_px(
    cameras: Sequence[Camera], keypoints: np.ndarray, free: Sequence[str], focal: Sequence[str] = ()
) -> float:
    """Return the trimmed cost of keypoints (C, frames, 25, 3), where each of `held_out_parts` is judged with cameras
    adjusted to the other."""
    costs = []
    for fitted, judged in held_out_parts(keypoints):
        adjusted = adjust(cameras, fitted, free, focal) if free else cameras
        costs.append(trimmed_cost_px(adjusted, judged))
    return float(np.mean(costs))

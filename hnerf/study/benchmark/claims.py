"""Checks of the paper's claims against a benchmark's result."""

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from hnerf.evaluation.evaluate import reason_without_surface
from hnerf.study.benchmark.curves import bin_edges, bin_means
from hnerf.study.benchmark.results import BINS, scatter_points, scored_methods, sweep_curves
from hnerf.tables import pick

Result = Mapping[str, Any]
Finding = tuple[bool, str]  # whether a score supports the claim, and the score in words

# Words, digits, and the sign of an improvement: -1 if less is better.
PSNR, CHAMFER = "psnr", "geometry.chamfer_l2_e3"
FIGURES = {PSNR: ("{} dB", 1, 1), CHAMFER: ("Chamfer {}", 3, -1)}
# What a different seed may cost: decibels, and a factor on the squared distance (docs/findings.md).
SEED_DB, SEED_RATIO = 0.4, 1.1
NOTHING = {PSNR: "no images", CHAMFER: "no surface"}
WEAK = 0.5  # absolute correlation below which there is no trend
NO_SURFACE = 0.1  # IoU below which a mesh does not count as the person's surface


def claim_lines(result: Result) -> list[str]:
    """Return a line of Markdown for each claim of the study: whether the scores support it, and the scores."""
    lines = []
    for claim in result["claims"]:
        findings = list(CHECKS[claim["check"]](result))
        verdict = "yes" if all(seen for seen, _ in findings) else "no"
        figures = "; ".join(words for _, words in findings)
        lines.append(
            f"- The paper: “{claim['says']}” Seen here: {f'{verdict}: {figures}' if findings else 'no figures'}."
        )
    return lines


def more_is_better(result: Result) -> Iterator[Finding]:
    """Check, for every method, that scores are better with the most cameras or frames than with the fewest, and never
    drop between consecutive values by more than seed noise. A method that fails does not support the claim, unless it
    fails with few cameras or frames and works with more."""
    methods = {name: None for variant in result["variants"].values() for name in variant["methods"]}
    for key, (_, _, sign) in FIGURES.items():
        curves = sweep_curves(result, key)
        counts = sorted({count for curve in curves.values() for count, _ in curve})
        for name in methods:
            curve = dict(curves.get(name, []))
            values = list(curve.values())
            for count in counts:
                if count not in curve and count > min(curve, default=0):
                    yield False, f"{count:g} {result['sweep']}: {name} {NOTHING[key]}"
            if len(values) > 1:
                falls = any(_falls(key, *step) for step in itertools.pairwise(values))
                yield sign * (values[-1] - values[0]) > 0 and not falls, f"{name} {_shown(key, *values)}"


def loses_least(result: Result) -> Iterator[Finding]:
    """Check that H-NeRF loses less than each other method from the most cameras or frames to the fewest, among those
    for which both have scores. Where only the other method has a score, the claim is not supported."""
    for key, (_, _, sign) in FIGURES.items():
        curves = {name: dict(curve) for name, curve in sweep_curves(result, key).items()}
        for first in _h_nerf(result, curves):
            for name in _others(result, curves):
                both = sorted(curves[first].keys() & curves[name].keys())
                for count in sorted(curves[name].keys() - curves[first].keys()):
                    words = f"{count:g} {result['sweep']}: {first} nothing, {name} {_shown(key, curves[name][count])}"
                    yield False, words
                if len(both) > 1:
                    few, many = both[0], both[-1]
                    lost = {m: sign * (curves[m][many] - curves[m][few]) for m in (first, name)}
                    words = f"{first} loses {_shown(key, lost[first])}, {name} {_shown(key, lost[name])}"
                    yield lost[first] < lost[name], words


def ahead(result: Result) -> Iterator[Finding]:
    """Check that H-NeRF has better scores than each other method in every variant, by however little. If H-NeRF was run
    and has no score, the claim is not supported."""
    for title, variant in result["variants"].items():
        for key, (_, _, sign) in FIGURES.items():
            values = {name: pick(scores[scores["split"]], key) for name, scores in scored_methods(variant).items()}
            known: dict[str, float] = {name: value for name, value in values.items() if value is not None}
            others = _others(result, known)
            for first in _h_nerf(result, variant.get("methods", {})) if others else ():
                best = max(others, key=lambda name: sign * known[name])
                mine = _shown(key, known[first]) if first in known else "nothing"
                words = f"{title}: {first} {mine}, {best} {_shown(key, known[best])}"
                yield first in known and sign * known[first] > sign * known[best], words


def falls_with_angle(result: Result) -> Iterator[Finding]:
    """Check, for every method, that the images farthest in angle from training cameras are worse than the nearest
    ones."""
    for title, by_method in _angles(result):
        for name, bins in by_method.items():
            (near, at_near, _), (far, at_far, _) = bins[min(bins)], bins[max(bins)]
            if len(bins) > 1:
                words = f"{title}: {name} {at_near:.1f} dB at {near:.0f}°, {at_far:.1f} at {far:.0f}°"
                yield at_far < at_near, words


def ahead_at_every_angle(result: Result) -> Iterator[Finding]:
    """Check that H-NeRF is better than each other method in every bin of angles in which both have scores. If H-NeRF
    was run and has no scores, the claim is not supported."""
    for title, by_method in _angles(result):
        for first in _h_nerf(result, result["variants"][title]["methods"]):
            for name in _others(result, by_method):
                if first not in by_method:
                    yield False, f"{title}: {first} nothing, {name} has scores"
                    continue
                bins, others = by_method[first], by_method[name]  # angles differ a little if fits differ
                leads = [bins[k][1] - others[k][1] for k in bins.keys() & others.keys()]
                if not leads:
                    continue
                yield min(leads) > 0, f"{title}: {min(leads):+.1f} to {max(leads):+.1f} dB to {name}"


def no_trend_with_pose(result: Result) -> Iterator[Finding]:
    """Check that the scores of H-NeRF's images of novel poses do not depend on the distance from the training poses."""
    for title, variant in result["variants"].items():
        found = scatter_points(variant, "novel_pose", "pose_distance_deg")
        for points in [found[name] for name in _h_nerf(result, found)]:
            if len({x for x, _ in points}) > 2:
                equal = len({y for _, y in points}) == 1  # which has no correlation, and no trend
                r = 0.0 if equal else float(np.corrcoef(np.array(points).T)[0, 1])
                yield abs(r) < WEAK, f"{title}: correlation {r:+.2f} over {len(points)} images"


def others_have_no_surface(result: Result) -> Iterator[Finding]:
    """Check that only H-NeRF has a surface that covers the person's volume."""
    for title, variant in result["variants"].items():
        scored = scored_methods(variant)
        for name in _others(result, scored):
            split = scored[name][scored[name]["split"]]
            iou = pick(split, "geometry.iou")
            if iou is not None:
                yield iou < NO_SURFACE, f"{title}: {name} IoU {iou:.2f}"
            elif reason_without_surface(split):
                yield True, f"{title}: {name} no surface"


CHECKS: dict[str, Callable[[Result], Iterator[Finding]]] = {
    check.__name__: check
    for check in (
        more_is_better,
        loses_least,
        ahead,
        falls_with_angle,
        ahead_at_every_angle,
        no_trend_with_pose,
        others_have_no_surface,
    )
}


def _h_nerf(result: Result, names: Collection[str]) -> list[str]:
    """Return the H-NeRF preset that claims are about; none if it is not among the methods."""
    return [name for name in result["own"][:1] if name in names]


def _others(result: Result, names: Iterable[str]) -> list[str]:
    """Return the methods that are not presets of H-NeRF."""
    return [name for name in names if name not in result["own"]]


def _falls(key: str, before: float, after: float) -> bool:
    """Return whether a score is worse than the previous one by more than another seed may cost."""
    return after < before - SEED_DB if key == PSNR else after > SEED_RATIO * before


def _shown(key: str, *values: float) -> str:
    words, digits, _ = FIGURES[key]
    return words.format(", ".join(f"{value:.{digits}f}" for value in values))


def _angles(result: Result) -> Iterator[tuple[str, dict[str, dict[int, tuple[float, float, int]]]]]:
    """Yield, for each variant, the mean angle, mean PSNR and count of every bin of view angles, by method."""
    for title, variant in result["variants"].items():
        found = scatter_points(variant, "novel_view", "view_angle_deg")
        edges = bin_edges(found.values(), BINS)
        yield title, {name: bin_means(points, edges) for name, points in found.items()}

"""A benchmark's result as tables (Markdown for people, CSV for spreadsheets), and as the data of its charts.

A result is a plain tree, as in the JSON file:

    {subject, study, part: whether methods or seconds are not the study's, title, notes, claims, seconds, until_flat,
     sweep, methods: [name], own: [name of an H-NeRF preset],
     variants: {title: {cameras, frames,
      methods: {name: scores of scoring.py, and "ended", a key of END_REASONS, if the study trains until curves
       are flat; or {"error": one line}}} or {"left_out": why}}}
"""

import csv
import io
import math
from collections.abc import Iterator, Mapping
from statistics import fmean
from typing import Any

from hnerf.evaluation.views import ANIMATED, NOVEL_VIEW, POSED, PRIMARY_SPLITS, TRACKED
from hnerf.files import markdown_image
from hnerf.study.benchmark.convergence import CURVE_PROTOCOL
from hnerf.study.benchmark.curves import Point, seconds_to_reach, value_at
from hnerf.study.machine import describe_machine
from hnerf.tables import pick, shown, table

SPLITS = {
    NOVEL_VIEW: "new views",
    ANIMATED: "animated new poses",
    POSED: "posed new poses",
    TRACKED: "tracked new poses",
}
CELL_LEGEND = (
    "Each cell holds new views / new poses animated / posed / tracked, as defined in the protocol below; for surfaces, "
    "new views / animated."
)
COLUMNS = {  # by key in a split's scores
    "psnr": ("PSNR, dB", "{:.2f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "mask_iou": ("mask IoU", "{:.3f}"),
    "lpips": ("LPIPS", "{:.3f}"),
    "geometry.chamfer_l2_e3": ("Chamfer x1e-3 m²", "{:.3f}"),
    "geometry.normal_consistency": ("NC", "{:.3f}"),
    "geometry.iou": ("IoU", "{:.3f}"),
}
COSTS = {  # by key in a training's report
    "seconds": ("training, s", "{:.0f}"),
    "peak_memory_gib": ("peak memory, GiB", "{:.1f}"),
    "model_mib": ("model, MiB", "{:.1f}"),
}
NEAR_BEST_DB = 1.0
BINS = 6  # over the distance from the training data
AFTER_S = {60.0: "60 s", 600.0: "10 min", 3600.0: "1 h"}
# Why a method was not trained longer.
END_REASONS = {"flat": "flat", "limit": "out of time", "steps": "its steps are done"}
TRIVIAL_PICTURES = {"one_colour_psnr": "one colour in the true outline", "empty_psnr": "an empty picture"}


def scored_methods(variant: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return a variant's methods that were trained and scored."""
    return {name: scores for name, scores in variant.get("methods", {}).items() if "error" not in scores}


def psnr_curves(variant: Mapping[str, Any]) -> dict[str, list[Point]]:
    """Return PSNR over training seconds, by method; only for methods whose images could be scored."""
    curves = {
        name: [(row["seconds"], row["psnr"]) for row in scores["curve"] if row["psnr"] is not None]
        for name, scores in scored_methods(variant).items()
    }
    return {name: curve for name, curve in curves.items() if curve}


def frame_points(variant: Mapping[str, Any]) -> dict[str, Point]:
    """Return, by method, the seconds per frame at the smallest timed size, and the PSNR of the finished model."""
    points = {}
    for name, scores in scored_methods(variant).items():
        seconds, psnr = scores["frame_seconds"], scores[scores["split"]]["psnr"]
        if psnr is not None:
            points[name] = (seconds[min(seconds, key=int)], psnr)
    return points


def trivial_psnr(variant: Mapping[str, Any]) -> dict[str, float]:
    """Return the PSNR of trivial images over the images of the curves, by title; empty if no image could be scored."""
    finals = [scores["curve"][-1] for scores in scored_methods(variant).values() if scores["curve"]]
    return {title: end[key] for end in finals[:1] for key, title in TRIVIAL_PICTURES.items() if end["psnr"] is not None}


def heading(title: str, variant: Mapping[str, Any]) -> str:
    """Return a variant's title and the splits that its charts show."""
    return f"{title}, {' and '.join(sorted({SPLITS[scores['split']] for scores in scored_methods(variant).values()}))}"


def smallest_timed_px(result: Mapping[str, Any]) -> str:
    """Return the smallest timed image size, as the length of its longest side."""
    return min((size for variant in result["variants"].values() for size in _sizes(variant)), key=int)


def sweep_curves(result: Mapping[str, Any], key: str) -> dict[str, list[Point]]:
    """Return, by method, a score of the finished model over the number of cameras or frames, in ascending order; the
    mean of variants that calibration left with the same number."""
    curves: dict[str, dict[int, list[float]]] = {}
    for variant in result["variants"].values():
        for name, scores in scored_methods(variant).items():
            if (value := pick(scores[scores["split"]], key)) is not None:
                curves.setdefault(name, {}).setdefault(scores["trained_on"][result["sweep"]], []).append(value)
    return {name: [(n, fmean(values)) for n, values in sorted(found.items())] for name, found in curves.items()}


def scatter_points(variant: Mapping[str, Any], split: str, x: str, y: str = "psnr") -> dict[str, list[Point]]:
    """Return, by method, the PSNR of every image of a split, or a score of its surfaces such as "chamfer_mm", over the
    distance of each from the training data, such as "view_angle_deg"."""
    found = {}
    for name, scores in scored_methods(variant).items():
        rows = scores[split]["per_image"] if y == "psnr" else (scores[split]["geometry"] or {}).get("per_surface", [])
        found[name] = [(row[x], row[y]) for row in rows]
    return {name: points for name, points in found.items() if points}


def end_reasons(variant: Mapping[str, Any]) -> dict[str, str]:
    """Return, for each method that was trained until its curve was flat, why it was not trained longer."""
    return {name: END_REASONS[scores["ended"]] for name, scores in scored_methods(variant).items() if "ended" in scores}


def near_best_seconds(variant: Mapping[str, Any]) -> dict[str, float | None]:
    """Return when each method came within 1 dB of a variant's best final PSNR; None if it never did."""
    curves = psnr_curves(variant)
    best = max((curve[-1][1] for curve in curves.values()), default=0.0)
    return {name: seconds_to_reach(curve, best - NEAR_BEST_DB) for name, curve in curves.items()}


def caption(result: Mapping[str, Any]) -> str:
    """Return what was measured, and on which machines."""
    machines = sorted(
        {describe_machine(s["machine"]) for v in result["variants"].values() for s in scored_methods(v).values()}
    )
    limit = f"{result['seconds']:g} s for each field" if result["seconds"] else "training to each preset's own end"
    limit = f"{CURVE_PROTOCOL}; {result['seconds']:g} s at most" if result["until_flat"] else limit
    return f"{result['subject']}, study {result['study']}: {limit}; on {'; on '.join(machines) or 'no machine yet'}."


def as_markdown(result: Mapping[str, Any], pictures: list[str], claims: list[str]) -> str:
    """Format the whole result for people. pictures: names of image files next to the text; claims: lines of
    claims.py."""
    lines = [f"# {result['title']}: {result['subject']}", "", caption(result), ""]
    lines += [f"- {note}" for note in result["notes"]] + [""] * bool(result["notes"])
    lines += [f"{markdown_image(name)}\n" for name in pictures] + claims + [""] * bool(claims)
    lines += [CELL_LEGEND, ""]
    for title, variant in result["variants"].items():
        lines += [f"## {title}", "", *_variant_lines(variant), ""]
    everything = [scores for variant in result["variants"].values() for scores in scored_methods(variant).values()]
    lines += [f"LPIPS: {text}." for text in sorted({scores["lpips"] for scores in everything})]
    return "\n".join([*lines, "", *sorted({scores["protocol"] for scores in everything}), ""])


def _variant_lines(variant: Mapping[str, Any]) -> list[str]:
    if "left_out" in variant:
        return [f"Left out: {variant['left_out']}."]
    sizes = _sizes(variant)
    titles = ["method", *(t for t, _ in COLUMNS.values()), *(t for t, _ in COSTS.values())]
    titles += [f"frame at {size} px, s" for size in sizes] + [f"s to best - {NEAR_BEST_DB:g} dB"]
    near_best = near_best_seconds(variant)
    rows, missing = [titles], dict[str, list[str]]()
    for name, scores in variant["methods"].items():
        if "error" in scores:
            rows.append([name, scores["error"]])
            continue
        cells = [cell(scores, key, form) for key, (_, form) in COLUMNS.items()]
        cells += [shown(scores["training"][key], form) for key, (_, form) in COSTS.items()]
        cells += [shown(scores["frame_seconds"].get(size), "{:.2f}") for size in sizes]
        rows.append([name, *cells, shown(near_best.get(name), "{:.0f}")])
        for reason in missing_figures(scores):
            missing.setdefault(reason, []).append(name)
        if scores["trained_on"] != {key: variant[key] for key in scores["trained_on"]}:
            fewer = "trained on {cameras} cameras and {frames} frames: calibration left the others out"
            missing.setdefault(fewer.format(**scores["trained_on"]), []).append(name)
    for key, title in TRIVIAL_PICTURES.items() if scored_methods(variant) else ():
        known = [[v for m in scored_methods(variant).values() if (v := m[s][key]) is not None] for s in SPLITS]
        of_each = " / ".join(shown(values[0] if values else None, "{:.2f}") for values in known)
        rows.append([title, of_each])
    taken = f"{variant['cameras']} training cameras, {variant['frames']} training frames.{_counts(variant)}"
    message = [f"- {', '.join(names)}: {reason}" for reason, names in missing.items()]
    return [taken, "", *table(rows), *_timeline(variant), *(["", *message] if message else [])]


def _counts(variant: Mapping[str, Any]) -> str:
    """Return how many images and surfaces a variant's scores are based on, as a sentence that starts with a space;
    empty if there are no scores. Methods that lack some scores have fewer."""
    found = list(scored_methods(variant).values())
    if not found:
        return ""
    images, surfaces = (
        " / ".join(str(max(pick(scores[split], key) or 0 for scores in found)) for split in PRIMARY_SPLITS)
        for key in ("n", "geometry.n")
    )
    of_curves = max((point["n"] for scores in found for point in scores["curve"]), default=0)
    splits = " / ".join(SPLITS[split] for split in PRIMARY_SPLITS)
    return f" Scored on {images} images and {surfaces} surfaces ({splits}), curves on {of_curves} images."


def cell(scores: Mapping[str, Any], key: str, form: str) -> str:
    """Return the score for every split that can have it, in the order of CELL_LEGEND."""
    return " / ".join(shown(pick(scores[split], key), form) for split in splits_of(key))


def splits_of(key: str) -> tuple[str, ...]:
    """Return the splits that have a score of COLUMNS; only the primary splits have surfaces."""
    return PRIMARY_SPLITS if key.startswith("geometry.") else tuple(SPLITS)


def _timeline(variant: Mapping[str, Any]) -> list[str]:
    """Return a table of the curves of methods that were trained until they were flat; no lines if there are none."""
    curves, why = psnr_curves(variant), end_reasons(variant)
    if not why:
        return []
    rows = [["method", *AFTER_S.values(), "at its end", "best", "ended"]]
    for name, curve in curves.items():
        (end_s, at_end), (best_s, best) = curve[-1], max(curve, key=lambda point: point[1])
        known_s = end_s if why[name] == END_REASONS["limit"] else math.inf  # a longer training would score higher
        values = [value_at(curve, seconds) if seconds <= known_s else None for seconds in AFTER_S]
        cells = [shown(value, "{:.2f}") for value in values]
        rows.append([name, *cells, f"{at_end:.2f}", f"{best:.2f} ({best_s:.0f} s)", f"{end_s:.0f} s, {why[name]}"])
    return ["", "PSNR of the curve's images, dB; linear in the logarithm of time between trainings.", "", *table(rows)]


def as_csv(result: Mapping[str, Any]) -> str:
    """Return a row for each method of each variant, with one score per cell; a missing score is an empty cell."""
    sizes = sorted({size for variant in result["variants"].values() for size in _sizes(variant)}, key=int)
    keys = [f"{split}.{key}" for split in SPLITS for key in COLUMNS if split in splits_of(key)]
    keys += [f"training.{key}" for key in COSTS]
    keys += [f"frame_seconds.{size}" for size in sizes]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["variant", "cameras", "frames", "method", *keys, "error"])
    for title, variant in result["variants"].items():
        for name, scores in variant.get("methods", {}).items():
            figures = ["" if (value := pick(scores, key)) is None else value for key in keys]
            writer.writerow([title, variant["cameras"], variant["frames"], name, *figures, scores.get("error", "")])
    return out.getvalue()


def missing_figures(scores: Mapping[str, Any]) -> Iterator[str]:
    """Yield the reasons why splits lack scores; a reason common to all novel poses is given once."""
    for split, name in SPLITS.items():
        if "reason" in scores[split] and (split in PRIMARY_SPLITS or "reason" not in scores[ANIMATED]):
            yield f"no images of {name}: {scores[split]['reason']}"
        elif "geometry_reason" in scores[split] and "reason" not in scores[split]:
            yield f"no surfaces of {name}: {scores[split]['geometry_reason']}"


def _sizes(variant: Mapping[str, Any]) -> list[str]:
    return sorted({size for scores in scored_methods(variant).values() for size in scores["frame_seconds"]}, key=int)

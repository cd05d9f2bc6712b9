"""A benchmark's result as tables: Markdown for people, CSV for spreadsheets; and what its charts show.

A result is a plain tree, as the JSON file has it:
    {subject, study, title, notes, claims, seconds, until_flat, sweep, methods: [name],
     variants: {title: {cameras, frames,
      methods: {name: scores of scoring.py, and "ended", a key of ENDS, where the study trains until curves
       are flat; or {"error": one line}}} or {"left_out": why}}}
"""

import csv
import io
import math
from collections.abc import Iterator, Mapping
from typing import Any

from hnerf.evaluation.views import ANIMATED, NOVEL_VIEW, POSED, PRIMARY_SPLITS, TRACKED
from hnerf.files import picture
from hnerf.study.benchmark.convergence import HOW
from hnerf.study.benchmark.curves import Point, seconds_to, value_at
from hnerf.study.machine import describe_machine
from hnerf.tables import head, line, pick, shown

SPLITS = {
    NOVEL_VIEW: "new views",
    ANIMATED: "animated new poses",
    POSED: "posed new poses",
    TRACKED: "tracked new poses",
}
CELL = (
    "In a cell: new views / new poses animated / posed / tracked, as the protocol below has it; of surfaces: new views "
    "/ animated."
)
COLUMNS = {  # in a split's scores
    "psnr": ("PSNR, dB", "{:.2f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "mask_iou": ("mask IoU", "{:.3f}"),
    "geometry.chamfer_l2_e3": ("Chamfer x1e-3 m²", "{:.3f}"),
    "geometry.normal_consistency": ("NC", "{:.3f}"),
    "geometry.iou": ("IoU", "{:.3f}"),
}
COSTS = {  # of a training
    "seconds": ("training, s", "{:.0f}"),
    "peak_memory_gib": ("peak memory, GiB", "{:.1f}"),
    "model_mib": ("model, MiB", "{:.1f}"),
}
NEAR_BEST_DB = 1.0
BINS = 6  # of the distance from training
AFTER_S = {60.0: "60 s", 600.0: "10 min", 3600.0: "1 h"}
ENDS = {"flat": "flat", "limit": "out of time", "steps": "its steps are done"}  # why a method has no longer training
TRIVIAL_PICTURES = {"one_colour_psnr": "one colour in the true outline", "empty_psnr": "an empty picture"}


def scored(variant: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """A variant's methods that were trained and scored."""
    return {name: scores for name, scores in variant.get("methods", {}).items() if "error" not in scores}


def psnr_curves(variant: Mapping[str, Any]) -> dict[str, list[Point]]:
    """Of each method: PSNR over training seconds; only methods of which images could be scored."""
    curves = {
        name: [(row["seconds"], row["psnr"]) for row in scores["curve"] if row["psnr"] is not None]
        for name, scores in scored(variant).items()
    }
    return {name: curve for name, curve in curves.items() if curve}


def frame_points(variant: Mapping[str, Any]) -> dict[str, Point]:
    """Of each method: seconds of a frame at the smallest size that was timed, and PSNR of the finished model."""
    methods = scored(variant).items()
    points = {
        name: (_smallest(scores["frame_seconds"])[1], scores[scores["split"]]["psnr"]) for name, scores in methods
    }
    return {name: (seconds, psnr) for name, (seconds, psnr) in points.items() if psnr is not None}


def trivial_psnr(variant: Mapping[str, Any]) -> dict[str, float]:
    """PSNR, over the images of the curves, of what needs no method; nothing where no image could be scored."""
    ends = [scores["curve"][-1] for scores in scored(variant).values() if scores["curve"]]
    return {title: end[key] for end in ends[:1] for key, title in TRIVIAL_PICTURES.items() if end["psnr"] is not None}


def heading(title: str, variant: Mapping[str, Any]) -> str:
    """A variant's title and what its charts are about."""
    return f"{title}, {' and '.join(sorted({SPLITS[scores['split']] for scores in scored(variant).values()}))}"


def timed_px(result: Mapping[str, Any]) -> str:
    """The smallest image, by its longest side, that was timed."""
    return min((size for variant in result["variants"].values() for size in _sizes(variant)), key=int)


def sweep_curves(result: Mapping[str, Any], key: str = "psnr") -> dict[str, list[Point]]:
    """Of each method: a figure of the finished model over the number of cameras or frames, in ascending order."""
    curves: dict[str, list[Point]] = {}
    for variant in result["variants"].values():
        for name, scores in scored(variant).items():
            if (value := pick(scores[scores["split"]], key)) is not None:
                curves.setdefault(name, []).append((scores["trained_on"][result["sweep"]], value))
    return {name: sorted(points) for name, points in curves.items()}


def clouds(variant: Mapping[str, Any], split: str, x: str, y: str = "psnr") -> dict[str, list[Point]]:
    """Of each method: PSNR of every image of a split, or a figure of its surfaces such as "chamfer_mm", over how far
    each is from training, such as "view_angle_deg"."""
    found = {}
    for name, scores in scored(variant).items():
        rows = scores[split]["per_image"] if y == "psnr" else (scores[split]["geometry"] or {}).get("per_surface", [])
        found[name] = [(row[x], row[y]) for row in rows]
    return {name: points for name, points in found.items() if points}


def ends(variant: Mapping[str, Any]) -> dict[str, str]:
    """Of each method that was trained until its curve was flat: why it was not trained for longer, in words."""
    return {name: ENDS[scores["ended"]] for name, scores in scored(variant).items() if "ended" in scores}


def near_best_seconds(variant: Mapping[str, Any]) -> dict[str, float | None]:
    """When each method came within 1 dB of the best end of all of a variant; None if it never did."""
    curves = psnr_curves(variant)
    best = max((curve[-1][1] for curve in curves.values()), default=0.0)
    return {name: seconds_to(curve, best - NEAR_BEST_DB) for name, curve in curves.items()}


def caption(result: Mapping[str, Any]) -> str:
    """What was measured, and on which machines."""
    machines = sorted({describe_machine(s["machine"]) for v in result["variants"].values() for s in scored(v).values()})
    limit = f"{result['seconds']:g} s for each field" if result["seconds"] else "training to each preset's own end"
    limit = f"{HOW}; {result['seconds']:g} s at most" if result["until_flat"] else limit
    return f"{result['subject']}, study {result['study']}: {limit}; on {'; on '.join(machines) or 'no machine yet'}."


def as_markdown(result: Mapping[str, Any], pictures: list[str], claims: list[str]) -> str:
    """The whole result for people. pictures: names of files beside the text; claims: lines of claims.py."""
    lines = [f"# {result['title']}: {result['subject']}", "", caption(result), ""]
    lines += [f"- {note}" for note in result["notes"]] + [""] * bool(result["notes"])
    lines += [f"{picture(name)}\n" for name in pictures] + claims + [""] * bool(claims)
    lines += [CELL, ""]
    for title, variant in result["variants"].items():
        lines += [f"## {title}", "", *_variant_lines(variant), ""]
    everything = [scores for variant in result["variants"].values() for scores in scored(variant).values()]
    lines += [f"LPIPS: {text}." for text in sorted({scores["lpips"] for scores in everything})]
    return "\n".join([*lines, "", *sorted({scores["protocol"] for scores in everything}), ""])


def _variant_lines(variant: Mapping[str, Any]) -> list[str]:
    if "left_out" in variant:
        return [f"Left out: {variant['left_out']}."]
    sizes = _sizes(variant)
    titles = ["method", *(t for t, _ in COLUMNS.values()), *(t for t, _ in COSTS.values())]
    titles += [f"frame at {size} px, s" for size in sizes] + [f"s to best - {NEAR_BEST_DB:g} dB"]
    near_best = near_best_seconds(variant)
    lines = [f"{variant['cameras']} training cameras, {variant['frames']} training frames.", ""]
    lines += head(titles)
    missing: dict[str, list[str]] = {}
    for name, scores in variant["methods"].items():
        if "error" in scores:
            lines.append(line([name, scores["error"].replace("|", "/"), *[""] * (len(titles) - 2)]))
            continue
        cells = [cell(scores, key, form) for key, (_, form) in COLUMNS.items()]
        cells += [shown(scores["training"][key], form) for key, (_, form) in COSTS.items()]
        cells += [shown(scores["frame_seconds"].get(size), "{:.2f}") for size in sizes]
        lines.append(line([name, *cells, shown(near_best.get(name), "{:.0f}")]))
        for reason in reasons(scores):
            missing.setdefault(reason, []).append(name)
        if scores["trained_on"] != {key: variant[key] for key in scores["trained_on"]}:
            fewer = "trained on {cameras} cameras and {frames} frames: calibration left the others out"
            missing.setdefault(fewer.format(**scores["trained_on"]), []).append(name)
    for key, title in TRIVIAL_PICTURES.items() if scored(variant) else ():
        known = [[v for m in scored(variant).values() if (v := m[s][key]) is not None] for s in SPLITS]
        of_each = " / ".join(shown(values[0] if values else None, "{:.2f}") for values in known)
        lines.append(line([title, of_each, *[""] * (len(titles) - 2)]))
    lines += _timeline(variant)
    message = [f"- {', '.join(names)}: {reason}" for reason, names in missing.items()]
    return [*lines, *(["", *message] if message else [])]


def cell(scores: Mapping[str, Any], key: str, form: str) -> str:
    """A figure of every split that can have it, as CELL says."""
    return " / ".join(shown(pick(scores[split], key), form) for split in splits_of(key))


def splits_of(key: str) -> tuple[str, ...]:
    """The splits that have a figure of COLUMNS: the primary ones have surfaces."""
    return PRIMARY_SPLITS if key.startswith("geometry.") else tuple(SPLITS)


def _timeline(variant: Mapping[str, Any]) -> list[str]:
    """A table of the curves of methods that were trained until they were flat; nothing where none was."""
    curves, why = psnr_curves(variant), ends(variant)
    if not why:
        return []
    lines = ["", "PSNR of the curve's images, dB; between trainings linear in the logarithm of time.", ""]
    lines += head(["method", *AFTER_S.values(), "at its end", "best", "ended"])
    for name, curve in curves.items():
        (end_s, at_end), (best_s, best) = curve[-1], max(curve, key=lambda point: point[1])
        known_s = end_s if why[name] == ENDS["limit"] else math.inf  # a longer training would have had more
        values = [value_at(curve, seconds) if seconds <= known_s else None for seconds in AFTER_S]
        cells = [shown(value, "{:.2f}") for value in values]
        lines.append(
            line([name, *cells, f"{at_end:.2f}", f"{best:.2f} ({best_s:.0f} s)", f"{end_s:.0f} s, {why[name]}"])
        )
    return lines


def as_csv(result: Mapping[str, Any]) -> str:
    """A row for each method of each variant, one figure a cell; empty where there is none."""
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


def reasons(scores: Mapping[str, Any]) -> Iterator[str]:
    """Why splits lack figures; where no new pose has any, that is told once."""
    for split, name in SPLITS.items():
        if "reason" in scores[split] and (split in PRIMARY_SPLITS or "reason" not in scores[ANIMATED]):
            yield f"no images of {name}: {scores[split]['reason']}"
        elif "geometry_reason" in scores[split] and "reason" not in scores[split]:
            yield f"no surfaces of {name}: {scores[split]['geometry_reason']}"


def _sizes(variant: Mapping[str, Any]) -> list[str]:
    return sorted({size for scores in scored(variant).values() for size in scores["frame_seconds"]}, key=int)


def _smallest(frame_seconds: Mapping[str, float]) -> tuple[str, float]:
    return min(frame_seconds.items(), key=lambda item: int(item[0]))

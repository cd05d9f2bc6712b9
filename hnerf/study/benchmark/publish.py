"""Files of a benchmark's result: JSON, CSV, Markdown and charts, next to each other."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hnerf.capture.capture import read_rgb
from hnerf.files import replace_text
from hnerf.study.benchmark import charts, results
from hnerf.study.benchmark.claims import claim_lines

PSNR, CHAMFER = "held-out PSNR, dB", "Chamfer distance"
ANGLE = "angle from the nearest training camera, degrees"
POSE = "angle from the nearest training pose, degrees a joint"
TRAINING_DISTANCE_PANELS = (  # distance, split, score, labels of the distance and the score
    ("view_angle_deg", "novel_view", "psnr", ANGLE, f"{PSNR} (an image)"),
    ("pose_distance_deg", "novel_pose", "psnr", POSE, f"{PSNR} (an image)"),
    ("pose_distance_deg", "novel_pose", "chamfer_mm", POSE, f"{CHAMFER} (a surface), mm"),
)
SWEEP_FIGURES = {"psnr": PSNR, "geometry.chamfer_l2_e3": f"{CHAMFER}, 1e-3 m²"}


def table_path(result: Mapping[str, Any], store: Path) -> Path:
    """Return `<store>/benchmark/<subject>-<study>.md`; the study's name ends in "-part" if only part of it was run."""
    return store / "benchmark" / f"{result['subject']}-{result['study']}{'-part' if result['part'] else ''}.md"


def publish(result: dict[str, Any], store: Path) -> Path:
    """Write a result's table, with CSV and JSON next to it, and redraw its PNGs; return the table's path."""
    table = table_path(result, store)
    table.parent.mkdir(parents=True, exist_ok=True)
    drawn = draw_charts(result, store, table)
    replace_text(table.with_suffix(".json"), json.dumps(result, indent=1) + "\n")
    replace_text(table.with_suffix(".csv"), results.as_csv(result))
    replace_text(table, results.as_markdown(result, [path.name for path in drawn], claim_lines(result)))
    return table


def draw_charts(result: Mapping[str, Any], store: Path, table: Path) -> list[Path]:
    """Draw every chart for which the result has scores; return their paths."""
    method_styles, caption, variants = charts.styles(result["methods"]), results.caption(result), result["variants"]
    paths = {name: table.with_name(f"{table.stem}{name}.png") for name in ("", "-sweep", "-nearness", "-pictures")}
    drawn = []
    rows = {}
    for title, variant in variants.items():
        curves, points = results.psnr_curves(variant), results.frame_points(variant)
        if curves or points:
            ends, trivial = results.end_reasons(variant), results.trivial_psnr(variant)
            rows[results.heading(title, variant)] = charts.SpeedRow(curves, ends, points, trivial)
    if rows:
        frame = f"time of a frame of {results.smallest_timed_px(result)} px, s (log scale)"
        charts.speed_chart(rows, method_styles, ("training, s (log scale)", frame, PSNR), caption, paths[""])
        drawn.append(paths[""])
    swept = {key: results.sweep_curves(result, key) for key in SWEEP_FIGURES} if result["sweep"] else {}
    if panels_of_sweep := [(SWEEP_FIGURES[key], curves) for key, curves in swept.items() if curves]:
        charts.sweep_chart(panels_of_sweep, method_styles, f"training {result['sweep']}", caption, paths["-sweep"])
        drawn.append(paths["-sweep"])
    near = [
        (f"{title}, {results.SPLITS[split]}", labels, clouds)
        for title, variant in variants.items()
        for x, split, y, *labels in TRAINING_DISTANCE_PANELS
        if (clouds := results.scatter_points(variant, split, x, y))
    ]
    if near:
        charts.training_distance_chart(near, method_styles, results.BINS, caption, paths["-nearness"])
        drawn.append(paths["-nearness"])
    pictures = [row for title, variant in variants.items() for row in picture_rows(title, variant, store)]
    if pictures:
        charts.picture_grid(pictures, caption, paths["-pictures"])
        drawn.append(paths["-pictures"])
    for path in set(paths.values()) - set(drawn):
        path.unlink(missing_ok=True)  # of an earlier call
    return drawn


def picture_rows(title: str, variant: Mapping[str, Any], store: Path) -> list[tuple[str, list[tuple[str, Any]]]]:
    """Return a row for each image shown: the ground truth, and each method's rendering of it, if any, with its PSNR."""
    found: dict[str, list[tuple[str, Any]]] = {}
    for name, scores in results.scored_methods(variant).items():
        folder = store / scores["folder"] / "pictures"
        psnr = {(row["camera"], row["frame"]): row["psnr"] for row in scores[scores["split"]]["per_image"]}
        for k, view in enumerate(scores["pictures"]):
            heading = f"{title}: frame {view['frame']}, camera {view['camera']}"
            row = found.setdefault(heading, [("truth", read_rgb(folder / f"{k}-truth.png"))])
            caption = f"{name}, {psnr[view['camera'], view['frame']]:.1f} dB"
            row.append((caption, read_rgb(folder / f"{k}-render.png")))
    return list(found.items())

"""Tables and charts of a synthetic result."""

import csv
import io
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hnerf.capture.capture import write_image
from hnerf.evaluation.images import unscored
from hnerf.study.benchmark import charts
from hnerf.study.benchmark.publish import picture_rows, publish
from hnerf.study.benchmark.results import (
    CELL_LEGEND,
    as_csv,
    as_markdown,
    caption,
    end_reasons,
    frame_points,
    heading,
    near_best_seconds,
    scatter_points,
    smallest_timed_px,
    sweep_curves,
    trivial_psnr,
)

MACHINE = {"cpu": "Abacus", "cores": 2, "threads": 1, "gpu": None, "torch": "2", "python": "3"}
SURFACES = [{"frame": 0, "chamfer_mm": 5.0, "pose_distance_deg": 3.0}]
GEOMETRY = {"n": 1, "chamfer_l2_e3": 0.05, "normal_consistency": 0.94, "iou": 0.875, "per_surface": SURFACES}


def split(psnr: float) -> dict[str, Any]:
    rows = [
        {"camera": "c", "frame": f, "psnr": psnr + f, "view_angle_deg": 40.0 + f, "pose_distance_deg": 3.0}
        for f in (0, 2)
    ]
    trivial_psnr = {"empty_psnr": 18.0, "one_colour_psnr": 25.0}
    return {
        "n": 2,
        "psnr": psnr,
        "ssim": 0.9,
        "mask_iou": 0.95,
        "lpips": 0.04,
        "per_image": rows,
        "geometry": GEOMETRY,
    } | trivial_psnr


def scores(psnr: float, frame_s: float, folder: str) -> dict[str, Any]:
    curve = [
        {"n": 1, "seconds": s, "psnr": db, "empty_psnr": 18.5, "one_colour_psnr": 25.5}
        for s, db in ((10.0, psnr - 4), (1e3, psnr))
    ]
    return {
        "machine": MACHINE,
        "protocol": "By eye.",
        "lpips": "not available: no weights",
        "split": "novel_view",
        "training": {"seconds": 61.7, "peak_memory_gib": 1.25, "model_mib": 28.5},
        "curve": curve,
        "trained_on": {"cameras": 4, "frames": 1},
        "novel_view": split(psnr),
        "novel_pose": unscored("no poses") | {"geometry": None, "geometry_reason": "no poses"},
        "novel_pose_posed": unscored("no poses"),
        "novel_pose_tracked": unscored("no poses"),
        "frame_seconds": {"1024": 4 * frame_s, "256": frame_s},
        "pictures": [{"camera": "c", "frame": 0}],
        "folder": folder,
    }


def result(**changes: Any) -> dict[str, Any]:
    methods = {
        "fast": scores(30.0, 0.5, "scoring/f"),
        "nerf": scores(26.0, 2.0, "scoring/n"),
        "idr": {"error": "a | b"},
    }
    few = {"fast": scores(28.0, 0.5, "scoring/f") | {"trained_on": {"cameras": 2, "frames": 1}}}
    return {
        "subject": "ada",
        "study": "toy",
        "part": False,
        "title": "Toys",
        "notes": ["A note."],
        "claims": [],
        "seconds": 60.0,
        "until_flat": False,
        "sweep": "cameras",
        "methods": ["fast", "nerf", "idr"],
        "own": ["fast"],
        "variants": {
            "4 cameras": {"cameras": 4, "frames": 1, "methods": methods},
            "2 cameras": {"cameras": 2, "frames": 1, "methods": few},
            "8 cameras": {"left_out": "the capture has 4 training cameras, not 8"},
        },
    } | changes


def test_the_markdown_by_hand() -> None:
    assert as_markdown(result(), ["a (b).png"], ["- A claim."]).splitlines()[:27] == [
        "# Toys: ada",
        "",
        "ada, study toy: 60 s for each field; on Abacus, 1 of 2 cores, no GPU, torch 2, Python 3.",
        "",
        "- A note.",
        "",
        "![a (b).png](<a (b).png>)",
        "",
        "- A claim.",
        "",
        CELL_LEGEND,
        "",
        "## 4 cameras",
        "",
        "4 training cameras, 1 training frames. Scored on 2 / 0 images and 1 / 0 surfaces (new views / animated new "
        "poses), curves on 1 images.",
        "",
        "| method | PSNR, dB | SSIM | mask IoU | LPIPS | Chamfer x1e-3 m² | NC | IoU | training, s | peak memory, GiB "
        "| model, MiB | frame at 256 px, s | frame at 1024 px, s | s to best - 1 dB |",
        "|" + "---|" * 14,
        "| fast | 30.00 / - / - / - | 0.900 / - / - / - | 0.950 / - / - / - | 0.040 / - / - / - "
        "| 0.050 / - | 0.940 / - | 0.875 / - | 62 | 1.2 | 28.5 | 0.50 "
        "| 2.00 | 316 |",
        "| nerf | 26.00 / - / - / - | 0.900 / - / - / - | 0.950 / - / - / - | 0.040 / - / - / - "
        "| 0.050 / - | 0.940 / - | 0.875 / - | 62 | 1.2 | 28.5 | 2.00 "
        "| 8.00 | - |",
        "| idr | a / b |  |  |  |  |  |  |  |  |  |  |  |  |",
        "| one colour in the true outline | 25.00 / - / - / - |  |  |  |  |  |  |  |  |  |  |  |  |",
        "| an empty picture | 18.00 / - / - / - |  |  |  |  |  |  |  |  |  |  |  |  |",
        "",
        "- fast, nerf: no images of animated new poses: no poses",
        "",
        "## 2 cameras",
    ]
    text = as_markdown(result(), [], [])
    assert "Left out: the capture has 4 training cameras, not 8." in text
    assert text.endswith("LPIPS: not available: no weights.\n\nBy eye.\n")


def test_methods_trained_until_flat_have_a_table_of_progress_and_end_reasons() -> None:
    """nerf rises from 22 dB at 10 s to 26 at 1000 s, so it has 22 + 2 lg 60 at 600 s. idr was never scored."""
    flat = result(until_flat=True)
    methods = flat["variants"]["4 cameras"]["methods"]
    methods["fast"] |= {
        "ended": "steps",
        "curve": [{"n": 1, "seconds": s, "psnr": db} for s, db in ((20, 31), (40, 30))],
    }
    methods["nerf"]["ended"] = "flat"
    lines = as_markdown(flat, [], []).splitlines()
    start = lines.index("| method | 60 s | 10 min | 1 h | at its end | best | ended |")
    assert lines[start + 2 : start + 5] == [
        "| fast | 30.00 | 30.00 | 30.00 | 30.00 | 31.00 (20 s) | 40 s, its steps are done |",
        "| nerf | 23.56 | 25.56 | 26.00 | 26.00 | 26.00 (1000 s) | 1000 s, flat |",
        "",
    ]
    methods["nerf"]["ended"] = "limit"
    assert "| nerf | 23.56 | 25.56 | - | 26.00 | 26.00 (1000 s) | 1000 s, out of time |" in as_markdown(flat, [], [])
    methods["nerf"]["ended"] = "flat"
    assert end_reasons(flat["variants"]["4 cameras"]) == {"fast": "its steps are done", "nerf": "flat"}
    assert "each from the start" in caption(flat) and "60 s at most" in caption(flat)


def test_new_poses_have_three_image_columns_and_one_surface_column() -> None:
    """The compared method tunes no poses."""
    several = result()
    methods = several["variants"]["4 cameras"]["methods"]
    columns = {"novel_pose": 27.0, "novel_pose_posed": 28.0, "novel_pose_tracked": 29.0}
    methods["fast"] |= {name: split(db) for name, db in columns.items()}
    methods["nerf"] |= {"novel_pose": split(22.0), "novel_pose_posed": unscored("no pose of these frames was tuned")}
    text, (fast, nerf, *_) = as_markdown(several, [], []), csv.DictReader(io.StringIO(as_csv(several)))
    assert "| fast | 30.00 / 27.00 / 28.00 / 29.00 |" in text and "| 0.050 / 0.050 |" in text
    assert "| nerf | 26.00 / 22.00 / - / - |" in text
    assert "- nerf: no images of posed new poses: no pose of these frames was tuned" in text
    assert (fast["novel_pose.psnr"], fast["novel_pose_posed.psnr"], fast["novel_pose_tracked.psnr"]) == (
        "27.0",
        "28.0",
        "29.0",
    )
    assert nerf["novel_pose_tracked.psnr"] == "" and "novel_pose_tracked.geometry.iou" not in fast


def test_cameras_that_calibration_left_out_are_noted_and_not_plotted() -> None:
    of_three = result()
    of_three["variants"]["4 cameras"]["methods"]["fast"]["trained_on"] = {"cameras": 3, "frames": 1}
    text = as_markdown(of_three, [], [])
    assert "- fast: trained on 3 cameras and 1 frames: calibration left the others out" in text
    assert sweep_curves(of_three, "psnr")["fast"] == [(2, 28.0), (3, 30.0)]
    of_three["variants"]["2 cameras"]["methods"]["fast"]["trained_on"] = {"cameras": 3, "frames": 1}
    assert sweep_curves(of_three, "psnr")["fast"] == [(3, 29.0)]


def test_a_method_without_a_scored_image_has_no_curve_and_does_not_change_the_counts() -> None:
    some = result()["variants"]["4 cameras"]
    nothing = {"n": 0, "psnr": None, "empty_psnr": None, "one_colour_psnr": None}
    some["methods"]["nerf"] |= {"curve": [nothing | {"seconds": 10.0}], "novel_view": split(26.0) | nothing}
    lines = as_markdown(result(variants={"4 cameras": some}), [], [])
    assert ". Scored on 2 / 0 images and 1 / 0 surfaces (new views / animated new poses), curves on 1 images." in lines
    assert near_best_seconds(some).keys() == {"fast"}
    del some["methods"]["fast"]
    assert trivial_psnr(some) == near_best_seconds(some) == {}


def test_the_csv_has_a_row_for_each_method_of_each_variant() -> None:
    rows = list(csv.DictReader(io.StringIO(as_csv(result()))))
    assert [(row["variant"], row["method"]) for row in rows] == [
        ("4 cameras", "fast"),
        ("4 cameras", "nerf"),
        ("4 cameras", "idr"),
        ("2 cameras", "fast"),
    ]
    assert rows[0]["novel_view.geometry.iou"] == "0.875" and rows[0]["novel_pose.psnr"] == ""
    assert rows[1]["frame_seconds.256"] == "2.0"
    assert rows[2]["error"] == "a | b" and rows[2]["novel_view.psnr"] == ""


def test_data_of_charts_by_hand() -> None:
    variants = result()["variants"]
    assert heading("4 cameras", variants["4 cameras"]) == "4 cameras, new views"
    assert smallest_timed_px(result()) == "256"
    assert frame_points(variants["4 cameras"]) == {"fast": (0.5, 30.0), "nerf": (2.0, 26.0)}
    assert sweep_curves(result(), "psnr") == {"fast": [(2, 28.0), (4, 30.0)], "nerf": [(4, 26.0)]}
    assert scatter_points(variants["2 cameras"], "novel_view", "view_angle_deg") == {
        "fast": [(40.0, 28.0), (42.0, 30.0)]
    }
    assert sweep_curves(result(), "geometry.chamfer_l2_e3")["fast"] == [(2, 0.05), (4, 0.05)]
    surfaces = scatter_points(variants["2 cameras"], "novel_view", "pose_distance_deg", "chamfer_mm")
    assert surfaces == {"fast": [(3.0, 5.0)]} and not scatter_points(
        variants["2 cameras"], "novel_pose", "view_angle_deg"
    )
    # from 26 dB at 10 s to 30 dB at 1000 s: 29 dB after three quarters of the way in log time
    near = near_best_seconds(variants["4 cameras"])
    assert near == {"fast": pytest.approx(10 * 100**0.75), "nerf": None}


def test_captions_name_limit_and_machine() -> None:
    assert "training to each preset's own end; on Abacus" in caption(result(seconds=None))
    assert caption(result(variants={})).endswith("on no machine yet.")


def write_pictures(store: Path) -> None:
    """Write the images of each method."""
    for name, grey in (("f", 200), ("n", 90)):
        for kind in ("render", "truth"):
            path = store / "scoring" / name / "pictures" / f"0-{kind}.png"
            write_image(path, np.full((40, 30, 3), grey, np.uint8))


def test_methods_scored_on_different_images_have_rows_of_their_own(tmp_path: Path) -> None:
    write_pictures(tmp_path)
    several = result()
    methods = several["variants"]["4 cameras"]["methods"]
    other = {"camera": "c", "frame": 2}
    methods["nerf"] |= {"pictures": [other], "novel_view": split(26.0) | {"per_image": [other | {"psnr": 26.0}]}}
    rows = picture_rows("4 cameras", several["variants"]["4 cameras"], tmp_path)
    assert [(title, [name for name, _ in row]) for title, row in rows] == [
        ("4 cameras: frame 0, camera c", ["truth", "fast, 30.0 dB"]),
        ("4 cameras: frame 2, camera c", ["truth", "nerf, 26.0 dB"]),
    ]


def test_a_study_without_final_scores_is_published_without_a_pareto_front(tmp_path: Path) -> None:
    nothing = scores(30.0, 0.5, "") | {"pictures": []}
    nothing["novel_view"] |= {"psnr": None, "per_image": []}
    publish(result(sweep=None, variants={"all": {"cameras": 4, "frames": 1, "methods": {"fast": nothing}}}), tmp_path)
    assert (tmp_path / "benchmark" / "ada-toy.png").exists()


def test_everything_is_published_and_old_charts_are_removed(tmp_path: Path) -> None:
    write_pictures(tmp_path)
    table = publish(result(), tmp_path)
    assert table == tmp_path / "benchmark" / "ada-toy.md"
    names = {path.name for path in table.parent.iterdir()}
    drawn = {f"ada-toy{name}.png" for name in ("", "-sweep", "-nearness", "-pictures")}
    assert names == {"ada-toy.md", "ada-toy.csv", "ada-toy.json"} | drawn
    assert all(f"![{name}](<{name}>)" in table.read_text() for name in drawn)
    assert json.loads(table.with_suffix(".json").read_text()) == result()
    publish(result(variants={}), tmp_path)
    assert {path.suffix for path in table.parent.iterdir()} == {".md", ".csv", ".json"}


def test_methods_differ_in_line_and_marker_for_prints_in_grey() -> None:
    looks = charts.styles([f"method {k}" for k in range(6)]).values()
    assert len({look["linestyle"] for look in looks}) == len({look["marker"] for look in looks}) == 6


def test_curve_ends_with_a_reason_are_marked_and_labelled() -> None:
    _, axes = charts._figure(1, 1)
    curves = {"a": [(10.0, 20.0), (20.0, 30.0)], "b": [(10.0, 21.0), (40.0, 25.0)]}
    charts.draw_curves(axes[0][0], curves, charts.styles(curves), {"a": "flat"})
    assert {text.get_text() for text in axes[0][0].texts} == {"a: flat", "b"}
    bars = [line for line in axes[0][0].lines if line.get_marker() == "|"]
    assert [line.get_xydata().tolist() for line in bars] == [[[20.0, 30.0]]]


def test_labels_at_line_ends_do_not_overlap() -> None:
    figure, axes = charts._figure(1, 1)
    curves = {"a": [(1.0, 20.0), (10.0, 30.0)], "b": [(1.0, 21.0), (10.0, 30.1)], "c": [(1.0, 10.0), (10.0, 15.0)]}
    charts.draw_curves(axes[0][0], curves, charts.styles(curves))
    figure.canvas.draw()
    boxes = sorted((text.get_window_extent() for text in axes[0][0].texts), key=lambda box: box.y0)
    assert len(boxes) == 3
    assert all(lower.y1 <= upper.y0 + 1 for lower, upper in itertools.pairwise(boxes))

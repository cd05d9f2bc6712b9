"""The evaluation report: one self-contained HTML file."""

import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import trimesh

from hnerf.capture.capture import read_rgba
from hnerf.config import EvaluationSettings
from hnerf.detection.people import PICTURE, REPORT
from hnerf.evaluation import charts
from hnerf.evaluation.galleries import Gallery, GalleryPicture, Row, surface_row, view_row
from hnerf.evaluation.ground_truth import GIVEN_MASKED_IMAGE, MASKED_IMAGE, UNDER_GIVEN_MASKS, GroundTruth
from hnerf.evaluation.images import TUNED_ON
from hnerf.evaluation.inputs import EvaluationInputs
from hnerf.evaluation.views import (
    ANIMATED,
    NOVEL_VIEW,
    POSED,
    PRIMARY_SPLITS,
    SPLITS,
    TRACKED,
    TRAINING_VIEW,
    View,
    all_views,
    sample_views,
)
from hnerf.files import png_data_uri
from hnerf.results.scores import HeldOutCamera, Metrics, Split
from hnerf.side_by_side import side_by_side
from hnerf.tables import pick, shown

FIGURES = (  # key in a split's scores, name, unit, format, meaning
    ("psnr", "PSNR", "dB", "{:.2f}", "Logarithmic pixel error. Higher is better; 3 dB more is half the squared error."),
    ("ssim", "SSIM", "", "{:.3f}", "Similarity of local structure: edges, folds, patterns. 1 is identical."),
    ("mask_iou", "Mask IoU", "", "{:.3f}", "Overlap of the rendered person and the true mask. 1 is identical."),
    ("lpips", "LPIPS", "", "{:.3f}", "Difference by a network trained on human judgement. 0 is identical."),
    ("geometry.chamfer_mm", "Surface distance", "mm", "{:.1f}", "Mean distance between the surface and the true one."),
    ("geometry.chamfer_l2_e3", "Chamfer", "m² × 10⁻³", "{:.3f}", "Mean squared distance; larger errors weigh more."),
    ("geometry.normal_consistency", "Normal consistency", "", "{:.3f}", "Agreement of the normals. 1 is identical."),
    ("geometry.iou", "Volume IoU", "", "{:.3f}", "Overlap of the volumes. 1 is identical."),
)
SPLIT_TITLES: dict[Split, str] = {
    NOVEL_VIEW: "New views",
    ANIMATED: "New poses, animated",
    POSED: "New poses, posed",
    TRACKED: "New poses, tracked",
}
COLUMNS = (  # of novel poses
    ("Animated", "poses as fitted before training, nothing tuned: how the avatar looks in any motion"),
    ("Posed", "poses tuned on the training cameras' images of these frames"),
    ("Tracked", "both the poses and a deformation of each frame tuned on those images"),
)
TEMPLATES = Path(__file__).parent / "templates"
LONG_LIST = 12  # values; longer lists are shown by their range


def write_report(
    inputs: EvaluationInputs,
    settings: EvaluationSettings,
    truth: GroundTruth,
    true_meshes: dict[int, trimesh.Trimesh],
    found: Metrics,
    out: Path,
) -> None:
    """Write `report.html` and its charts into `out`, from the renderings and meshes there and the stages' reports."""
    stages = stage_reports(inputs)
    template = report_environment().get_template("report.html")
    page = template.render(
        capture=inputs.capture,
        size_px=image_sizes(inputs),
        split_titles=SPLIT_TITLES,
        columns=COLUMNS,
        reasons=[*missing_figures(found), *under_given_masks(found)],
        held_out=held_out_rows(found),
        found=found,
        summary=summary(found),
        galleries=galleries(inputs, settings, truth, true_meshes, found, out),
        training_charts=training_charts(inputs.training_folder / "history.jsonl", out),
        frame_charts=frame_charts(found, out),
        people_picture=png_uri(inputs.capture.root / PICTURE),
        rig_picture=png_uri(inputs.calibration_folder / "cameras.png"),
        evidence_picture=png_uri(inputs.calibration_folder / "witnesses.png"),
        stages=stages,
        costs=costs(stages, found),
        notes=reading_notes(inputs, found),
    )
    (out / "report.html").write_text(page, encoding="utf-8")


def report_environment(*folders: Path) -> jinja2.Environment:
    """Return the environment of pages that look like the report; folders: of templates in addition to the report's
    own."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([*folders, TEMPLATES]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["readable"] = readable
    environment.tests["rows"] = is_table_rows
    return environment


def stage_reports(inputs: EvaluationInputs) -> dict[str, dict[str, Any]]:
    """Return the report of each earlier stage, an empty dict for one that left none."""
    folders = {
        "Calibration": inputs.calibration_folder,
        "Segmentation": inputs.segmentation_folder,
        "Body fit": inputs.fit_folder,
        "Training": inputs.training_folder,
    }
    paths = {name: folder / "report.json" for name, folder in folders.items()}
    if (detection := inputs.capture.root / REPORT).exists():
        paths = {"Detection": detection} | paths
    reports = {name: json.loads(path.read_text()) if path.exists() else {} for name, path in paths.items()}
    if inputs.fit_seconds:
        reports["Body fit"] |= {"seconds": inputs.fit_seconds}
    return reports


def image_sizes(inputs: EvaluationInputs) -> str:
    """Return the distinct image sizes, like "256 × 256"."""
    sizes = {camera.size_px for camera in inputs.capture.cameras.values()}
    return ", ".join(f"{width} × {height}" for width, height in sorted(sizes))


def summary(found: Metrics) -> list[dict[str, Any]]:
    """Return one row for each metric: name, unit, meaning, and the value for each split ("–" if there is none)."""
    rows = []
    for key, name, unit, form, meaning in FIGURES:
        values = [pick(found[split], key) for split in SPLITS]
        cells = ["–" if value is None else form.format(value) for value in values]
        rows.append({"name": name, "unit": unit, "meaning": meaning, "values": cells})
    return rows


def held_out_rows(found: Metrics) -> list[list[str]]:
    """Return the cells of a table: a row for each held-out camera, and their mean."""
    if found["holdout"] is None:
        return []
    forms = {key: form for key, _, _, form, _ in FIGURES if not key.startswith("geometry.")}
    scores: dict[str, Any] = {f"Camera {name}": by_split for name, by_split in found["holdout"]["cameras"].items()}
    return [
        [name, *(shown(by_split[split][key], form) for split in PRIMARY_SPLITS for key, form in forms.items())]
        for name, by_split in (scores | {"Mean": found["holdout"]["mean"]}).items()
    ]


def galleries(
    inputs: EvaluationInputs,
    settings: EvaluationSettings,
    truth: GroundTruth,
    true_meshes: dict[int, trimesh.Trimesh],
    found: Metrics,
    out: Path,
) -> list[Gallery]:
    """Return the galleries of training views, novel views and novel poses that have images, of held-out cameras, and of
    surfaces."""
    made = []
    for split in (TRAINING_VIEW, NOVEL_VIEW, ANIMATED):
        views = dict.fromkeys(sample_views(all_views(inputs.capture, split), settings.report_rows), "")
        if split in SPLITS and found[split]["per_image"]:
            worst = min(found[split]["per_image"], key=lambda score: score["psnr"])
            views[View(split, worst["camera"], worst["frame"])] = f"the worst of this split, {worst['psnr']:.1f} dB"
        rendered = [view for view in views if view.path(out).exists()]  # none of new poses, if a method has none

        def row(view: View, notes: dict[View, str] = views) -> Row:
            others = _other_columns(view, out)
            return view_row(view, read_rgba(view.path(out)), inputs, truth, notes[view], inputs.fitted, others)

        if rendered:
            made.append(Gallery(*_gallery_text(split, inputs), list(side_by_side(row, rendered))))
    if found["holdout"]:
        made.append(held_out_gallery(inputs, found["holdout"]["cameras"]))
    return [*made, surface_gallery(inputs, true_meshes, out)]


def _other_columns(view: View, out: Path) -> dict[str, np.ndarray]:
    """Return, by caption, the renderings of the same image in the other columns of novel poses."""
    paths = {name: replace(view, split=split).path(out) for name, split in (("Posed", POSED), ("Tracked", TRACKED))}
    return {name: read_rgba(path) for name, path in paths.items() if view.split == ANIMATED and path.exists()}


def held_out_gallery(inputs: EvaluationInputs, cameras: dict[str, HeldOutCamera]) -> Gallery:
    """Return a gallery of the first scored image of each held-out camera, for training frames and for novel poses."""
    rows = []
    for folder, (camera, scores) in zip(inputs.held_out_folders, cameras.items(), strict=True):
        for split in PRIMARY_SPLITS:
            for score in scores[split]["per_image"][:1]:
                view = View(split, camera, score["frame"])
                note = f"{SPLIT_TITLES[split].lower()}, {score['psnr']:.1f} dB"
                rows.append(view_row(view, read_rgba(view.path(folder)), inputs, None, note, None, {}))
    text = "Cameras that were used neither for the body nor for the field shown here, compared under their own masks."
    return Gallery("Cameras left out", text, rows)


def _gallery_text(split: str, inputs: EvaluationInputs) -> tuple[str, str]:
    if split == TRAINING_VIEW:
        return "Training views", "Views used in training: how well the avatar reproduces its own data. Not a test."
    if split == "novel_view":
        return "New views", "Training frames, seen from cameras that were not used in training."
    frames = "Frames that the field was not trained on, in poses as fitted before training (Render), as tuned on the"
    frames += " training cameras' images of them (Posed), and with a tuned deformation of each frame as well (Tracked),"
    if inputs.capture.test_cameras:
        return "New poses", f"{frames} seen from cameras that were used neither in the fit nor in training."
    return "New poses", f"{frames} seen from the training cameras. Not a test: the capture has no test camera."


def surface_gallery(inputs: EvaluationInputs, true_meshes: dict[int, trimesh.Trimesh], out: Path) -> Gallery:
    """Return a gallery of the first mesh of the training frames and of the novel-pose frames, front and back."""
    frames = sorted(int(path.stem) for path in (out / "meshes").glob("*.ply"))
    capture, body = inputs.capture, inputs.avatar.body
    notes: dict[int, str] = {}
    for members, note in ((capture.train_frames, "training pose"), (capture.novel_pose_frames, "new pose")):
        notes |= dict.fromkeys([frame for frame in frames if frame in members][:1], note)

    def row(frame: int) -> Row:
        mesh = trimesh.load_mesh(out / "meshes" / f"{frame:06d}.ply", process=False)
        root = body.root[body.index(frame)].cpu().numpy()
        return surface_row(frame, mesh, true_meshes.get(frame), root, notes[frame])

    rows = list(side_by_side(row, notes))
    return Gallery("Surface", "The zero surface of the signed distance, without colour.", rows)


def training_charts(history_path: Path, out: Path) -> list[GalleryPicture]:
    """Draw losses and held-out quality over training time, if the history has them."""
    history = [json.loads(line) for line in history_path.read_text().splitlines()] if history_path.exists() else []
    drawn = {
        "Losses": (out / "losses.png", charts.loss_chart(history, out / "losses.png")),
        "Held-out quality": (out / "quality.png", charts.quality_chart(history, out / "quality.png")),
    }
    return [GalleryPicture(title, png_uri(path)) for title, (path, exists) in drawn.items() if exists]


def frame_charts(found: Metrics, out: Path) -> list[GalleryPicture]:
    """Draw the PSNR by frame of every split that was scored."""
    paths = {split: out / f"psnr_{split}.png" for split in SPLITS}
    scored = [split for split in SPLITS if charts.frame_chart(found[split]["per_image"], paths[split])]
    return [GalleryPicture(f"{SPLIT_TITLES[split]}, frame by frame", png_uri(paths[split])) for split in scored]


def png_uri(path: Path) -> str:
    """Return a PNG file as a data URI, or "" if there is no such file."""
    return png_data_uri(path) if path.exists() else ""


def costs(stages: dict[str, dict[str, Any]], found: Metrics) -> list[tuple[str, str]]:
    """Return what the run cost: seconds of each stage and of its parts if recorded, memory, model size, time of one
    image."""
    rows = []
    for name, report in (stages | {"Evaluation": found}).items():
        seconds = report.get("seconds", {})
        parts = {f"{name}: {part}": s for part, s in seconds.items()} if isinstance(seconds, dict) else {name: seconds}
        rows += [(f"{part}, seconds", readable(s)) for part, s in parts.items()]
    rows.append(("Rendering, seconds per image", readable(found["seconds_per_image"])))
    training = stages["Training"]
    sizes = ("device", "processes", "steps", "peak_memory_gib", "parameters", "model_mib")
    return rows + [(key.replace("_", " ").capitalize(), readable(training[key])) for key in sizes if key in training]


def reading_notes(inputs: EvaluationInputs, found: Metrics) -> list[str]:
    """Return notes on what is missing from the scores, or must be kept in mind when reading them."""
    lines = [f"LPIPS is {found['lpips']}.", *missing_figures(found), *under_given_masks(found)]
    for split in PRIMARY_SPLITS:
        scores, title = found[split], SPLIT_TITLES[split]
        if "geometry_reason" in scores:
            lines.append(f"{title}: no surface scores: {scores['geometry_reason']}.")
        if MASKED_IMAGE in scores.get("reference", ""):
            lines.append(f"{title}: compared to photographs under the true mask, whose edge pixels contain background.")
        if scores.get("without_mask"):
            lines.append(f"{title}: {scores['without_mask']} images have no mask to score them by.")
        if scores.get("without_person"):
            lines.append(f"{title}: {scores['without_person']} images do not show the person and are not scored.")
    if not inputs.capture.test_cameras:
        lines.append(
            "Without a test camera this field is not scored on images; the report shows training views instead."
        )
    return lines


def missing_figures(found: Metrics) -> list[str]:
    """Return one line for each reason why splits have no image scores."""
    by_reason: dict[str, list[str]] = {}
    for split in SPLITS:
        if "reason" in found[split]:
            by_reason.setdefault(found[split]["reason"], []).append(SPLIT_TITLES[split])
    lines = [f"{'; '.join(titles)}: no image scores: {reason}." for reason, titles in by_reason.items()]
    if TUNED_ON in by_reason and found["holdout"] is None:
        lines.append(f"Cameras left out: no scores: {found['holdout_reason']}.")
    return lines


def under_given_masks(found: Metrics) -> list[str]:
    """Return one line that says which splits were compared to photographs under given masks, if any were."""
    titles = [SPLIT_TITLES[split] for split in SPLITS if found[split].get("reference") == GIVEN_MASKED_IMAGE]
    return [f"{'; '.join(titles)}: compared to {UNDER_GIVEN_MASKS}."] if titles else []


def is_table_rows(value: Any) -> bool:
    """Return whether values are dicts of plain values, which a table can show as rows."""
    if not isinstance(value, Collection) or isinstance(value, str | Mapping) or not value:
        return False
    return all(isinstance(row, dict) and not any(isinstance(cell, dict) for cell in row.values()) for row in value)


def readable(value: Any) -> str:
    """Format a scalar, or a list of scalars, in few characters."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 9999.5 else f"{value:.0f}"
    if isinstance(value, list | tuple):
        flat = list(_leaves(value))
        if len(flat) > LONG_LIST and all(isinstance(v, int | float) for v in flat):
            return f"{len(flat)} values from {readable(min(flat))} to {readable(max(flat))}"
        return ", ".join(readable(v) for v in value) or "none"
    return str(value)


def _leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, list | tuple):
        for inner in value:
            yield from _leaves(inner)
    else:
        yield value

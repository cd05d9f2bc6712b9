"""The work of each command, by its options. A function's docstring is the help of its command.

Each function imports what it needs, so that the others, and help, need not wait for torch and Prefect.
"""

import argparse
import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

from flows.settings_list import settings_list
from hnerf.config import Settings, SyntheticSettings, load_settings, overridden
from hnerf.errors import InputError
from hnerf.files import atomic_folder, require_new

DEMO = Path("demo")


def run(options: argparse.Namespace) -> None:
    """Train one person and export the avatar."""
    _train(options.capture, options.preset, options.store, options.overrides)


def settings(options: argparse.Namespace) -> None:
    """List every setting that --set takes: its value in the preset, its type, and what it means."""
    print("\n".join(["hnerf run --set", *settings_list(load_settings(options.preset))]))
    print("\n".join(["\nhnerf synth --set", *settings_list(SyntheticSettings())]))


def models(options: argparse.Namespace) -> None:
    """Download the networks for people, faces, hands and LPIPS, and three.js for the viewer; needed once."""
    from hnerf.models import fetch_models

    print(f"networks: {fetch_models()}")


def demo(options: argparse.Namespace) -> None:
    """Synthesise a capture and train on it, in ./demo; takes minutes."""
    capture = DEMO / "performer"
    if not capture.exists():
        _write_capture(capture, SyntheticSettings())
    _train(capture, "demo", DEMO / "store", [])


def _train(capture: Path | str, preset: str, store: Path, overrides: list[str]) -> None:
    from flows.train_subject import train_subject

    trained = train_subject.fn(capture, preset, store, overrides)
    print(f"report:  {trained.report}")
    print(f"asset:   {trained.asset or 'none'}")
    print(f"subject: {trained.subject}")


def synth(options: argparse.Namespace) -> None:
    """Write a synthetic capture with ground truth."""
    _write_capture(options.out, overridden(SyntheticSettings(), options.overrides))


def _write_capture(out: Path, settings: SyntheticSettings) -> None:
    with atomic_folder(out) as partial:
        from hnerf.synthetic import write_synthetic_capture

        write_synthetic_capture(partial, settings)


def check_cameras(options: argparse.Namespace) -> None:
    """Check the calibration of a capture, and print a verdict for each camera."""
    from flows.preparation import ingest_recording, with_detections
    from hnerf.capture.capture import Capture
    from tasks.calibration import calibrate
    from tasks.source import read_capture
    from tasks.store import Store

    settings, store = load_settings(options.preset, options.overrides), Store(options.store.resolve())
    source, _ = read_capture(options.capture, options.store)
    recording = with_detections(store, ingest_recording(store, source, settings), settings)
    calibration = calibrate(store, recording, settings.calibration)
    report = json.loads((calibration.root / "report.json").read_text())
    print("\n".join([*_table(report), *Capture.load(recording.root).notes]))
    print(f"picture: {calibration.root / 'cameras.png'}")


def _table(report: dict[str, Any]) -> Iterator[str]:
    """Yield a calibration report as lines for people."""
    yield f"{'camera':<12} {'status':<9} {'median px':>9} {'95 % px':>9}  remarks"
    for name, camera in report["cameras"].items():
        median, p95 = ("-" if px is None else f"{px:.2f}" for px in (camera["median_px"], camera["p95_px"]))
        remarks = "; ".join(camera["reasons"])
        yield f"{name:<12} {camera['status']:<9} {median:>9} {p95:>9}  {remarks}".rstrip()
    for name in report["unjudged_cameras"]:
        yield f"{name:<12} not judged: a camera for testing"
    yield from report["doubts"]
    yield from report["notes"]
    yield f"verdict: {report['verdict']}"


def fit(options: argparse.Namespace) -> None:
    """Fit the body alone, and write its motion as BVH and TRC files; `run` goes on from there."""
    with atomic_folder(options.out) as partial:
        from flows.preparation import ingest_recording, prepare_training, with_detections
        from hnerf.asset.bvh_file import require_dense, write_body_motion
        from hnerf.body.fit_result import BodyFit
        from hnerf.body.keypoint_fit import metres_per_pixel
        from hnerf.capture.capture import Capture
        from tasks.calibration import calibrated_capture
        from tasks.source import read_capture
        from tasks.store import Store

        settings, store = load_settings(options.preset, options.overrides), Store(options.store.resolve())
        source, _ = read_capture(options.capture, options.store)
        recorded = ingest_recording(store, source, settings)
        require_dense(Capture.load(recorded.root))  # the stages after this one take minutes
        prepared = prepare_training(store, with_detections(store, recorded, settings), settings)
        capture = calibrated_capture(prepared.recording, prepared.calibration)
        body = BodyFit.load(prepared.body.root)
        write_body_motion(partial, capture, body, settings.asset.joint_names)
    made = (prepared.calibration, prepared.body)
    checked, report = (json.loads((artifact.root / "report.json").read_text()) for artifact in made)
    pixel_m = metres_per_pixel(tuple(capture.cameras[name] for name in capture.train_cameras), body).mean(0).tolist()
    print("\n".join(_fit_quality(checked, report, pixel_m)))
    print(_frame_counts(body.frames, capture.fps))
    print(f"report: {prepared.body.root / 'report.json'}")
    print(f"motion: {options.out / 'motion.bvh'}, {options.out / 'motion.trc'}")


def _fit_quality(checked: dict[str, Any], report: dict[str, Any], pixel_m: list[float]) -> Iterator[str]:
    """Yield the reports of calibration and fit as lines for people. pixel_m: what a pixel spans, by frame."""
    yield from [*checked["doubts"], *report.get("doubts", ())]
    cameras = [
        f"{name} {camera['status']}" + (f" ({camera['median_px']:.1f} px)" if camera["median_px"] is not None else "")
        for name, camera in checked["cameras"].items()
    ]
    yield f"cameras: {', '.join(cameras)}; `hnerf check-cameras` says more"
    rows = zip(report["keypoint_residual_px"], pixel_m, report["frames"], strict=True)
    seen = [(px, 1e3 * span_m * px, frame) for px, span_m, frame in rows if px is not None]
    if seen:
        px, mm = median(row[0] for row in seen), median(row[1] for row in seen)
        worst_px, _, frame = max(seen)
        yield f"keypoints: {px:.1f} px from the body's, about {mm:.0f} mm; most in frame {frame}: {worst_px:.1f} px"
    yield f"stature: {report['stature_m']:.2f} m"
    yield f"fitted poorly: {report['poor_frames'] or 'no frame'}"


def _frame_counts(frames: Sequence[int], fps: float) -> str:
    """Return how many frames of a motion were fitted, for people."""
    from hnerf.asset.motions import LONGEST_S

    between = [b - a - 1 for a, b in pairwise(frames)]
    held = sum(count for count in between if count + 1 > LONGEST_S * fps + 1e-6)
    counts = {"fitted": len(frames), "interpolated": sum(between) - held, f"held in gaps over {LONGEST_S} s": held}
    listed = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
    advice = "; for a pose in every frame, raise capture.max_frames" if sum(between) else ""
    return f"frames: {frames[0]} to {frames[-1]}, {fps:.4g} a second: {listed}{advice}"


def calibrate(options: argparse.Namespace) -> None:
    """Calibrate cameras from footage of a board, or from the person."""
    for name, source in {"ground_frame": "boards", "height": "person", "lens": "person", "fov": "person"}.items():
        if source != options.source and getattr(options, name) is not None:
            why = f"has no effect with --from {options.source}; leave it out, or give --from {source}"
            raise InputError(f"--{name.replace('_', '-')}: {why}")
    read = _calibrate_from_person if options.source == "person" else _calibrate_from_boards
    with atomic_folder(options.out) as partial:
        _read_in_cage(read, options, partial)
    print(_advice(options.out, options.folder))


def _advice(out: Path, folder: Path) -> str:
    """Return how to use the new cameras in `out` for a capture, in words."""
    from hnerf.capture.ingest import hiding_calibrations

    advice = f"cameras: {out}; copy its files into {folder} to use them"
    hiding = " and ".join(map(str, hiding_calibrations(folder, out)))
    return f"{advice}; remove {hiding}, which would be read instead" if hiding else advice


def _calibrate_from_boards(options: argparse.Namespace, out: Path) -> None:
    from hnerf.calibration.boards.calibrate import calibrate_from_boards

    found = calibrate_from_boards(options.folder, options.ground_frame)
    found.save(out, options.format, _is_pose2sim(options.folder))
    print(f"{'camera':<12} {'pictures':>8} {'RMS px':>7}  intrinsics")
    report = found.report()
    for name, camera in report["cameras"].items():
        print(f"{name:<12} {camera['pictures']:>8} {camera['rms_px']:>7.2f}  {camera['intrinsics']}")
    print(f"all: {report['rms_px']:.2f} px RMS\npicture: {options.out / 'boards.png'}")


def _calibrate_from_person(options: argparse.Namespace, out: Path) -> None:
    from hnerf.calibration.person.recording import calibrate_recording

    found = calibrate_recording(options.folder, options.height, options.lens, options.fov)
    found.save(out, options.format, _is_pose2sim(options.folder))
    print(f"{'camera':<12} {'median px':>9} {'+- degrees':>10} {'+- cm':>6} {'+- % focal':>10}  intrinsics")
    for name, camera in found.report()["cameras"].items():
        off = camera["uncertainty"]
        figures = f"{off['turn_deg']:>10.2f} {100 * off['move_m']:>6.1f} {100 * off['focal']:>10.1f}"
        print(f"{name:<12} {camera['median_px']:>9.2f} {figures}  {camera['intrinsics']}")
    print("\n".join(found.notes()))


def _is_pose2sim(folder: Path) -> bool:
    """Return whether a recording is read in Pose2Sim's layout once it has a calibration in that layout: other
    calibrations in the folder may take precedence."""
    from hnerf.capture.formats.pose2sim import Pose2Sim
    from hnerf.capture.ingest import LAYOUTS

    preceding = LAYOUTS[: LAYOUTS.index(Pose2Sim)]
    return (folder / "pose").is_dir() and not any(layout.recognises(folder) for layout in preceding)


def synchronise(options: argparse.Namespace) -> None:
    """Find the start offset and the clock drift of each camera; write clocks.toml."""
    from hnerf.capture.clocks import FILE

    path = options.folder / FILE
    if path.exists():
        raise InputError(f"{path}: exists; remove it to synchronise again")
    _read_in_cage(_synchronise, options, path)


def _synchronise(options: argparse.Namespace, path: Path) -> None:
    from hnerf.calibration.clocks.recording import synchronise_recording
    from hnerf.capture.clocks import write_clocks

    found, sources = synchronise_recording(options.folder)
    write_clocks(path, found.clocks)
    print(f"{'camera':<12} {'offset s':>9} {'+- ms':>6} {'drift ppm':>9}  from")
    for name, clock in found.clocks.items():
        error_ms, ppm = 1e3 * found.error_s[name], 1e6 * (clock.rate - 1)
        print(f"{name:<12} {clock.offset_s:>+9.4f} {error_ms:>6.1f} {ppm:>+9.0f}  {sources[name]}")
    for (a, b), why in found.refused.items():
        print(f"{a} and {b} were not compared: {why}")
    print(f"clocks: {path}")


def export_cameras(options: argparse.Namespace) -> None:
    """Write the cameras of a capture in the format of another tool."""
    with atomic_folder(options.out) as partial:
        _read_in_cage(_export_cameras, options, partial)
    print(f"cameras: {options.out}")


def _export_cameras(options: argparse.Namespace, out: Path) -> None:
    from hnerf.capture.formats.export import write_cameras
    from hnerf.capture.ingest import exported_lenses

    write_cameras(out, exported_lenses(options.folder), options.format)


def _read_in_cage(read: Callable[[argparse.Namespace, Path], None], options: argparse.Namespace, out: Path) -> None:
    """Call `read(options, out)` in a separate process, with the limits that the options set."""
    from tasks.cage import run_caged
    from tasks.limits import set_limits

    _check_section(options, "limits")
    set_limits(overridden(Settings(), options.overrides).limits)
    run_caged(read, options, out, folder=options.folder)


def _check_section(options: argparse.Namespace, section: str) -> None:
    """Raise InputError for settings of other sections."""
    for override in options.overrides:
        if override.partition("=")[0].split(".")[0] != section:
            raise InputError(
                f"--set {override}: this command takes settings of the section `{section}` only; remove it"
            )


def benchmark(options: argparse.Namespace) -> None:
    """Compare methods: accuracy against training and frame time."""
    from flows.benchmark import benchmark as flow

    table = flow.fn(options.capture, options.study, options.methods, options.seconds, options.store)
    _show(table)
    if (chart := table.with_suffix(".png")).exists():
        print(f"chart: {chart}")


def ablate(options: argparse.Namespace) -> None:
    """Train without each part of the method in turn; write a table of the scores."""
    from flows.ablations import ablate as flow

    _show(flow.fn(options.capture, options.preset, options.store, options.overrides, options.only))


def stability(options: argparse.Namespace) -> None:
    """Degrade a capture in many ways, and report what breaks."""
    from flows.stability import stability as flow

    _show(flow.fn(options.capture, options.study, options.store, options.methods, options.only))


def _show(table: Path) -> None:
    print(f"{table.read_text()}\ntable: {table}")


def render(options: argparse.Namespace) -> None:
    """Render images and video of a trained person."""
    require_new(options.out)  # before imports and files that take seconds
    from hnerf.render.subject import RenderOptions, render_subject

    _require_intact(options.subject, [options.motion] if options.motion else [])
    wanted = RenderOptions(
        camera=options.camera,
        path=options.path,
        radius_m=options.radius,
        height_m=options.height,
        motion=options.motion,
        frames=options.frames,
        between=options.between and tuple(options.between),
        shape=_shape_changes(options.shape),
        volume=None if options.volume is None else options.volume / 100,
        what=tuple(dict.fromkeys(options.what)),
        size_px=options.size,
        pictures=options.pictures,
    )
    print(f"{render_subject(options.subject, wanted, options.out)} pictures: {options.out}")


def view(options: argparse.Namespace) -> None:
    """Show a trained person in a browser, rendered live in any view, pose and shape; needs the extra `view`."""
    from hnerf.render.page import view_subject

    _require_intact(options.subject, options.motion)
    view_subject(options.subject, options.motion, options.host, options.port)


def export(options: argparse.Namespace) -> None:
    """Export the asset of a trained person again, with other settings or more motions."""
    _check_section(options, "asset")
    require_new(options.out)  # before imports and files that take seconds
    from hnerf.asset.subject import export_subject
    from tasks.store import recording_digest

    _require_intact(options.subject, options.motion)
    allowed = ["asset.allow_poor=true"] if options.allow_poor else []
    settings = load_settings(options.preset, options.overrides + allowed).asset
    digest = recording_digest(options.subject)
    report = export_subject(options.subject, settings, options.motion, options.out, digest, options.blender)
    motions = ", ".join(f"{name} ({m['poses']} poses)" for name, m in report["motions"].items())
    print(f"motions: {motions}\nasset: {options.out / 'avatar.usda'}")


def _require_intact(subject: Path, motions: list[Path]) -> None:
    """Raise InputError if results of a subject, or of one whose motion is shown, were changed."""
    from tasks.store import require_intact

    for folder in (subject, *(motion for motion in motions if motion.is_dir())):
        require_intact(folder)


def _shape_changes(texts: list[str]) -> dict[str, float]:
    changes = dict(map(_shape_change, texts))
    if len(changes) < len(texts):
        raise InputError(f"--shape {' --shape '.join(texts)}: give each name once")
    return changes


def _shape_change(text: str) -> tuple[str, float]:
    name, _, amount = text.partition("=")
    with suppress(ValueError):
        if math.isfinite(change := float(amount)):
            return name, change
    raise InputError(f"--shape {text}: give a name and what to add, like weight=+0.4")

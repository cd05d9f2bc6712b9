"""The command line: the flows' work from a shell, without a server."""

import argparse
import dataclasses
import errno
import json
import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from flows.ablations import ablate
from flows.benchmark import benchmark
from flows.stability import stability
from flows.train_subject import train_subject
from hnerf.asset.validation import InvalidAsset
from hnerf.calibration.boards.calibrate import calibrate_from_boards
from hnerf.capture.formats.export import WRITERS, write_cameras
from hnerf.capture.ingest import recognise
from hnerf.capture.manifest import read_manifest
from hnerf.config import SyntheticSettings, load_settings, overridden
from hnerf.errors import InputError
from hnerf.files import atomic_folder
from hnerf.render.subject import OUTPUT_KINDS, RenderOptions, render_subject
from hnerf.synthetic import write_synthetic_capture
from tasks.calibration import calibrate
from tasks.capture import ingest
from tasks.launcher import RankFailedError
from tasks.policy import is_permanent
from tasks.source import read_capture
from tasks.store import Store, require_intact

DEMO = Path("demo")
FAILED, BAD_INPUT = 1, 2
NO_ROOM = (None, errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # None: our own, of libraries that do not say why


def main(argv: list[str] | None = None) -> int:
    """Run one command; one line on stderr and 2 for input and paths that cannot be used, 1 for a training that cannot
    go on or an asset that must not be handed over."""
    options = _parser().parse_args(argv)
    try:
        with _progress():
            options.command(options)
    except InputError as error:
        return _fail(error, BAD_INPUT)
    except (RankFailedError, InvalidAsset) as error:
        return _fail(error, FAILED)
    except OSError as error:
        if error.errno in NO_ROOM:
            return _fail(f"{error}; make room and give the same command again", FAILED)
        if error.filename is None or not is_permanent(error):
            raise
        return _fail(f"{error.filename}: {error.strerror}; give another path, or mend this one", BAD_INPUT)
    return 0


def _fail(why: object, status: int) -> int:
    print("hnerf:", " ".join(str(why).splitlines()), file=sys.stderr)
    return status


@contextmanager
def _progress() -> Iterator[None]:
    """The library's log on stdout, instead of Prefect's console handler, which writes to stderr."""
    logger, handler = logging.getLogger("hnerf"), logging.StreamHandler(sys.stdout)
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s", "%H:%M:%S"))
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = True


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="hnerf", description="From a folder of calibrated video to an avatar.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    capture, preset = (argparse.ArgumentParser(add_help=False) for _ in range(2))
    capture.add_argument("capture", type=Path, help="the recording's folder")
    capture.add_argument("--store", type=Path, default=Path("store"), help="where results are kept (default: store)")
    preset.add_argument("--preset", default="fast", help="a name under configs/ or a YAML file (default: fast)")

    def of_capture(name: str, *more: argparse.ArgumentParser, what: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=what, parents=[capture, *more])

    run = of_capture("run", preset, what="train one person and export the avatar")
    run.add_argument("--set", dest="overrides", action="append", default=[], metavar="a.b=c", help="override a setting")
    run.set_defaults(command=lambda o: _run(o.capture, o.preset, o.store, o.overrides))

    check = of_capture("check-cameras", preset, what="read a recording and check its cameras, nothing more")
    check.set_defaults(command=lambda o: _check(o.capture, o.preset, o.store))

    boards = commands.add_parser("calibrate", help="find the cameras from footage of a calibration board")
    boards.add_argument("folder", type=Path, help="a folder with calibration/extrinsic/ and charuco.toml")
    boards.add_argument("--out", type=Path, default=Path("cameras"), help="the folder to write (default: cameras)")
    boards.add_argument("--format", choices=WRITERS, action="append", default=[], help="write these files, too")
    boards.add_argument(
        "--ground-frame", type=_not_negative, metavar="N", help="when the board lies on the floor, at the origin"
    )
    boards.set_defaults(command=lambda o: _calibrate(o.folder, o.out, o.format, o.ground_frame))

    cameras = commands.add_parser("export-cameras", help="write a recording's cameras as other tools read them")
    cameras.add_argument("folder", type=Path, help="a recording, or a folder that `calibrate` wrote")
    cameras.add_argument("--format", choices=WRITERS, required=True)
    cameras.add_argument("--out", type=Path, default=Path("cameras"), help="the folder to write (default: cameras)")
    cameras.set_defaults(command=lambda o: _cameras(o.folder, o.format, o.out))

    _add_benchmark(of_capture("benchmark", what="compare methods: accuracy against training and frame time"))

    ablations = of_capture("ablate", preset, what="train without each part of the method in turn: a table")
    ablations.add_argument("--set", dest="overrides", action="append", default=[], metavar="a.b=c", help="in all rows")
    ablations.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only these of configs/ablations/")
    ablations.set_defaults(command=lambda o: _show(ablate.fn(o.capture, o.preset, o.store, o.overrides, o.only)))

    _add_stability(of_capture("stability", what="make a capture worse in many ways: what breaks"))
    _add_render(commands.add_parser("render", help="pictures and video of a trained person"))

    synth = commands.add_parser("synth", help="write a synthetic capture with ground truth")
    synth.add_argument("out", type=Path, help="the folder to write")
    synth.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="a=b", help="such as train_cameras=32"
    )
    synth.set_defaults(command=lambda o: _synth(o.out, o.overrides))

    demo = commands.add_parser("demo", help=f"synth and run in ./{DEMO}, in minutes")
    demo.set_defaults(command=lambda o: _demo())
    return parser


def _add_benchmark(command: argparse.ArgumentParser) -> None:
    study = command.add_mutually_exclusive_group()
    study.add_argument(
        "--study", default="dynamic", help="a name under configs/benchmark/ or a YAML file (default: dynamic)"
    )
    study.add_argument("--quick", dest="study", action="store_const", const="quick", help="the study for 15 minutes")
    command.add_argument(
        "--methods", type=_names, metavar="LIST", help="of the study, or presets, instead of all: fast,nerf"
    )
    command.add_argument("--seconds", type=_positive, metavar="S", help="of every training, instead of the study's")
    command.set_defaults(command=_benchmark)


def _names(text: str) -> list[str]:
    return [stripped for name in text.split(",") if (stripped := name.strip())]


def _not_negative(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError("give 0 or more")
    return value


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError("give seconds above 0")
    return value


def _benchmark(options: argparse.Namespace) -> None:
    table = benchmark.fn(options.capture, options.study, options.methods, options.seconds, options.store)
    _show(table)
    if (chart := table.with_suffix(".png")).exists():
        print(f"chart: {chart}")


def _add_stability(command: argparse.ArgumentParser) -> None:
    study = command.add_mutually_exclusive_group()
    study.add_argument("--study", default="full", help="a name under configs/stability/ or a YAML file (default: full)")
    study.add_argument("--quick", dest="study", action="store_const", const="quick", help="the study for 15 minutes")
    command.add_argument("--methods", type=_names, default=[], metavar="LIST", help="presets")
    command.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only these degradations of the study")
    command.set_defaults(command=lambda o: _show(stability.fn(o.capture, o.study, o.store, o.methods, o.only)))


def _add_render(render: argparse.ArgumentParser) -> None:
    render.add_argument("subject", type=Path, help="<store>/subjects/<name>, as `run` left it")
    render.add_argument("--out", type=Path, default=Path("pictures"), help="the folder to write (default: pictures)")
    render.add_argument(
        "--what", default="colour", metavar="LIST", help=f"of {','.join(OUTPUT_KINDS)} (default: colour)"
    )
    view = render.add_mutually_exclusive_group()
    view.add_argument("--camera", help="a recorded camera's name (default: an orbit)")
    view.add_argument("--path", type=Path, help="a JSON list of cameras, or a folder of them, to fly along")
    render.add_argument("--radius", type=float, metavar="M", help="of the orbit (default: the recorded cameras')")
    render.add_argument("--height", type=float, metavar="M", help="of the orbit over the person's middle")
    render.add_argument("--motion", type=Path, help="another subject's folder, or an AMASS .npz (default: its own)")
    render.add_argument("--frames", default=":", metavar="A:B:STEP", help="poses to show, or one number (default: all)")
    render.add_argument("--between", type=int, nargs=2, metavar="FRAME", help="interpolate between two frames' poses")
    render.add_argument("--shape", action="append", default=[], metavar="NAME=+X", help="add to a shape value")
    render.add_argument("--volume", type=float, metavar="PERCENT", help="change of the body's volume, like -40 or 80")
    render.add_argument("--size", type=int, metavar="PX", help="longest side of a picture (default: as recorded)")
    render.add_argument("--pictures", type=int, metavar="N", help="how many (default: one a pose)")
    render.set_defaults(command=_render)


def _render(options: argparse.Namespace) -> None:
    for subject in (options.subject, options.motion):
        if subject and subject.is_dir():
            require_intact(subject)
    wish = RenderOptions(
        camera=options.camera,
        path=options.path,
        radius_m=options.radius,
        height_m=options.height,
        motion=options.motion,
        frames=options.frames,
        between=options.between and tuple(options.between),
        shape=dict(map(_shape_change, options.shape)),
        volume=None if options.volume is None else options.volume / 100,
        what=tuple(dict.fromkeys(options.what.split(","))),
        size_px=options.size,
        pictures=options.pictures,
    )
    print(f"{render_subject(options.subject, wish, options.out)} pictures: {options.out}")


def _shape_change(text: str) -> tuple[str, float]:
    name, _, amount = text.partition("=")
    try:
        return name, float(amount)
    except ValueError:
        raise InputError(f"shape {text}: give a name and what to add, like weight=+0.4") from None


def _run(capture: Path, preset: str, store: Path, overrides: list[str]) -> None:
    folder = train_subject.fn(capture, preset, store, overrides)
    print(f"report: {folder / 'evaluation' / 'report.html'}")
    print(f"asset:  {folder / 'asset' / 'avatar.usdz'}")


def _show(table: Path) -> None:
    print(f"{table.read_text()}\ntable: {table}")


def _check(capture: Path, preset: str, store: Path) -> None:
    settings = load_settings(preset)
    artifact_store = Store(store.resolve())
    source, _ = read_capture(capture, store)
    recording = ingest(artifact_store, source, settings.capture)
    calibration = calibrate(artifact_store, recording, settings.calibration)
    print("\n".join(_table(json.loads((calibration.root / "report.json").read_text()))))
    print(f"picture: {calibration.root / 'cameras.png'}")


def _table(report: dict[str, Any]) -> list[str]:
    """A calibration report as lines for people."""
    lines = [f"{'camera':<12} {'status':<9} {'median px':>9} {'95 % px':>9}  remarks"]
    for name, camera in report["cameras"].items():
        median, p95 = ("-" if px is None else f"{px:.2f}" for px in (camera["median_px"], camera["p95_px"]))
        remarks = "; ".join(camera["reasons"])
        lines.append(f"{name:<12} {camera['status']:<9} {median:>9} {p95:>9}  {remarks}".rstrip())
    lines += [f"{name:<12} not judged: a camera for testing" for name in report["unjudged_cameras"]]
    return [*lines, *report["notes"], f"verdict: {report['verdict']}"]


def _calibrate(folder: Path, out: Path, layouts: list[str], ground_frame: int | None) -> None:
    with atomic_folder(out) as partial:
        found = calibrate_from_boards(folder, ground_frame)
        found.save(partial, layouts)
    print(f"{'camera':<12} {'pictures':>8} {'RMS px':>7}  intrinsics")
    report = found.report()
    for name, camera in report["cameras"].items():
        print(f"{name:<12} {camera['pictures']:>8} {camera['rms_px']:>7.2f}  {camera['intrinsics']}")
    print(f"all: {report['rms_px']:.2f} px RMS\ncameras: {out}\npicture: {out / 'boards.png'}")


def _cameras(folder: Path, layout: str, out: Path) -> None:
    with atomic_folder(out) as partial:
        lenses = recognise(folder).lenses().values()
        metres_per_unit = read_manifest(folder).metres_per_unit
        write_cameras(partial, [dataclasses.replace(lens, t_m=metres_per_unit * lens.t_m) for lens in lenses], layout)
    print(f"cameras: {out}")


def _synth(out: Path, overrides: Sequence[str] = ()) -> None:
    settings = overridden(SyntheticSettings(), overrides)
    with atomic_folder(out) as partial:
        write_synthetic_capture(partial, settings)


def _demo() -> None:
    capture = DEMO / "performer"
    if not capture.exists():
        _synth(capture)
    _run(capture, "demo", DEMO / "store", [])

"""The command line: runs the flows' work from a shell, without a server."""

import argparse
import errno
import io
import logging
import os
import select
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from flows import commands
from flows.arguments import MAX_COUNT, number, path, path_or_bucket_url
from flows.display import display
from flows.ending import Terminated, drop_what_is_left, open_closed_streams, unwound_by_signals
from flows.store_commands import add_store_commands
from hnerf.config import load_settings, require_named_files
from hnerf.errors import DISK_FULL, REASON, UNREACHABLE, InputError, InvalidAsset
from tasks.launcher import LostWorkerError, RankFailedError
from tasks.limits import StalledError
from tasks.store import NAME, Store

FAILED, BAD_INPUT, INTERRUPTED, ENDED = 1, 2, 130, 128  # as in shells: 128 plus the signal's number
NO_ROOM = (None, *DISK_FULL, errno.EFBIG)  # None: our own errors, for libraries that do not say why
CAMERA_FORMATS = ("easymocap", "caliscope", "aniposelib", "colmap")  # as in hnerf.capture.formats.export
PICTURES = ("colour", "depth", "normals", "mask", "mesh")  # as in hnerf.render.subject, which imports torch
SIZES_PX = (2, 8000)  # of an image's side, as in the same module
ORBIT_PICTURES = 60  # as in the same module
STATURE_M = (0.5, 2.3)  # as in hnerf.calibration.diagnosis, which imports numpy
MAX_M = 1000
FOLDERS = {
    "capture": "the capture folder, or one video",
    "folder": "the capture folder",
    "subject": "<store>/subjects/<name> of a finished `hnerf run`",
}  # options of commands that are folders, and what each is

# Variables that name a folder with caches, and where below it these are; the first that is set counts.
CACHES = {"HNERF_MODELS": "", "ANNY_CACHE_DIR": "", "WARP_CACHE_PATH": "", "XDG_CACHE_HOME": "", "HOME": ".cache"}
MOTIONS = "a BVH file, an AMASS .npz, another subject's folder, or t-pose"
T_POSE = Path("t-pose")  # as in hnerf.render.motion, which imports torch

Command = Callable[[argparse.Namespace], None]
log = logging.getLogger("hnerf")


def main(argv: list[str] | None = None) -> int:
    """Run one command; return its exit code. Errors are one line on stderr. The code is 2 for input and paths that
    cannot be used; 1 for a training that cannot continue, an asset that must not be delivered, or output that nobody
    reads; 130 if interrupted from the keyboard; 143 after SIGTERM, 129 after SIGHUP."""
    open_closed_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # as standard error: names outside the terminal's encoding
    try:
        return _run(argv)
    finally:
        drop_what_is_left()


def _run(argv: list[str] | None) -> int:
    """Run one command; return the exit code."""
    try:
        _require_current_folder()
        options = _options(argv)
        with unwound_by_signals(), display():
            folders = _existing(options)
            if options.command.__module__ == commands.__name__ and options.command is not commands.settings:
                log.info("%s", " ".join([_name(options.command), *map(str, folders)]))
            options.command(options)
        sys.stdout.flush()
    except Terminated as error:
        return _fail(f"ended by {error.signal.name}", ENDED + error.signal)
    except KeyboardInterrupt:
        return _fail("interrupted", INTERRUPTED)
    except InputError as error:
        return _fail(error, BAD_INPUT)
    except (RankFailedError, LostWorkerError, StalledError, InvalidAsset) as error:
        return _fail(error, FAILED)
    except RuntimeError as error:
        if not isinstance(error.__context__, OSError) or error.__context__.errno != errno.ELOOP:
            raise
        return _fail(f"{error}; give another path, or mend this one", BAD_INPUT)  # Path.resolve
    except OSError as error:
        if isinstance(error, BrokenPipeError) and _reader_has_left():
            return FAILED
        from tasks.bucket import BucketError

        if isinstance(error, BucketError):
            return _fail(error, FAILED)
        if error.errno in NO_ROOM:
            return _fail(f"{error}; make room and give the same command again", FAILED)
        if error.errno in UNREACHABLE:
            return _fail(f"{error}; give the same command again", FAILED)
        from tasks.policy import is_permanent  # imports Prefect

        if error.filename is None or not is_permanent(error):
            raise
        return _fail(f"{error.filename}: {error.strerror}; {_remedy(str(error.filename))}", BAD_INPUT)
    return 0


def _remedy(path: str) -> str:
    """Return what to do about a path that cannot be used. For a cache, or a folder above it, name its variable."""
    for variable, below in CACHES.items():
        cache = Path(os.environ.get(variable, ""), below)
        if os.environ.get(variable) and (Path(path).is_relative_to(cache) or cache.is_relative_to(path)):
            return f"it is needed for the cache {cache}; mend it, or let {variable} name another folder"
    return "give another path, or mend this one"


def _require_current_folder() -> None:
    """Raise InputError if the current folder was removed, as by a script that made it anew: libraries crash there."""
    try:
        os.getcwd()
    except FileNotFoundError:
        raise InputError("the current folder was removed; change to another one") from None


def _options(argv: list[str] | None) -> argparse.Namespace:
    try:
        return _parser().parse_args(argv)
    finally:
        sys.stdout.flush()  # prints the help, after which argparse ends the process


def _fail(why: object, status: int) -> int:
    with suppress(OSError):  # nobody reads it, or there is no room
        print(f"{REASON}{' '.join(str(why).splitlines())}", file=sys.stderr)
    return status


def _reader_has_left() -> bool:
    """Return whether nobody reads standard output any more, as after `| head -1`."""
    poll = select.poll()
    poll.register(sys.stdout, 0)
    return any(events & select.POLLERR for _, events in poll.poll(0))


def _existing(options: argparse.Namespace) -> list[Path]:
    """Return the folders that a command reads. Raises InputError for faults that can be found without slow imports."""
    if "preset" in options:
        settings = load_settings(options.preset, getattr(options, "overrides", ()))
        if "capture" in options:
            require_named_files(settings)
    folders = {what: given for name, what in FOLDERS.items() if isinstance(given := getattr(options, name, None), Path)}
    for what, folder in folders.items():
        if not (folder.is_dir() or (what == FOLDERS["capture"] and folder.is_file())):
            wanted = "folder or video" if what == FOLDERS["capture"] else "folder"
            raise InputError(f"{folder}: {'is not a' if folder.exists() else 'no such'} {wanted}; give {what}")
    motions = getattr(options, "motion", None) or []
    for motion in motions if isinstance(motions, list) else [motions]:
        if not motion.exists() and motion != T_POSE:
            raise InputError(f"{motion}: no such file; give {MOTIONS}")
    if isinstance(out := getattr(options, "out", None), Path):
        _require_outside_artifacts(out)
        if "capture" in options and out.resolve().is_relative_to(options.store.resolve()):
            raise InputError(f"{out}: lies in the store, where stages write; give another")
        if _recording(options) in out.resolve().parents:
            raise InputError(f"{out}: lies in the recording, whose results would be computed again; give another")
    for option in ("path", "lens"):
        file = getattr(options, option, None)
        if file and not file.exists():
            raise InputError(f"{file}: no such file; give --{option} another")
    return list(folders.values())


def _require_outside_artifacts(out: Path) -> None:
    """Raise InputError if new output would lie in an artifact of a store, among its recorded files."""
    for folder in out.resolve().parents:
        if NAME.fullmatch(f"{folder.parent.name}/{folder.name}") and folder.with_name(f"{folder.name}.json").is_file():
            raise InputError(f"{out}: lies in the results of a run, which would count as damaged; give another")


def _recording(options: argparse.Namespace) -> Path | None:
    """Return the recording that a command reads or whose results it reads; None if it is not known."""
    if options.command is commands.export_cameras:
        return options.folder.resolve()
    if options.command is commands.fit:
        return options.capture.resolve()
    if "name" in options:
        subject = options.store / "subjects" / options.name
    elif "subject" in options:
        subject = options.subject
    else:
        return None
    folder = subject.resolve()
    noted = Store(folder.parent.parent).recording_folder(folder.name)
    return Path(noted) if noted else None


def _name(command: Command) -> str:
    return command.__name__.replace("_", "-")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="hnerf", description="From video of a person to an animatable avatar.")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")

    store, preset = (argparse.ArgumentParser(add_help=False) for _ in range(2))
    store.add_argument("--store", type=path, default="store", help="folder of results (default: store)")
    capture = argparse.ArgumentParser(add_help=False, parents=[store])
    capture.add_argument("capture", type=path, help="capture folder, or one video")
    preset.add_argument("--preset", default="fast", help="preset of configs/, or a YAML file (default: fast)")

    def add(command: Command, *parents: argparse.ArgumentParser) -> argparse.ArgumentParser:
        """Add a command named after its function, with the docstring as help."""
        what = command.__doc__
        added = subparsers.add_parser(_name(command), help=what, description=what, parents=parents)
        added.set_defaults(command=command)
        return added

    run = add(commands.run, store, preset)
    run.add_argument("capture", type=path_or_bucket_url, help="capture folder, its URL in a bucket, or one video")
    fit, check = add(commands.fit, capture, preset), add(commands.check_cameras, capture, preset)
    _add_out(fit, "motion")
    for staged in (run, fit, check):
        _add_overrides(staged, "override a setting; `hnerf settings` lists all")
    add(commands.settings, preset)

    caged = argparse.ArgumentParser(add_help=False)
    _add_overrides(caged, "override a setting under `limits.`")
    _add_calibrate(add(commands.calibrate, caged))
    synchronise = add(commands.synchronise, caged)
    what = "capture, calibrated or not, whose cameras did not start together"
    synchronise.add_argument("folder", type=path, help=what)
    cameras = add(commands.export_cameras, caged)
    what = "capture folder, what `hnerf calibrate` wrote, or cameras/ or calibration/ of a subject"
    cameras.add_argument("folder", type=path, help=what)
    cameras.add_argument("--format", choices=CAMERA_FORMATS, required=True, help="format to write")
    _add_out(cameras, "cameras")

    _add_benchmark(add(commands.benchmark, capture))
    _add_ablate(add(commands.ablate, capture, preset))
    _add_stability(add(commands.stability, capture))
    _add_render(add(commands.render))
    _add_view(add(commands.view))
    _add_export(add(commands.export, preset))
    what = "List, check, clean up and transfer what the store holds."
    add_store_commands(subparsers.add_parser("store", help=what, description=what))
    synth = add(commands.synth)
    synth.add_argument("out", type=path, help="new folder to write")
    _add_overrides(synth, "override a setting, like train_cameras=32; `hnerf settings` lists all at its end")
    add(commands.models)
    add(commands.demo)
    return parser


def _add_overrides(command: argparse.ArgumentParser, what: str) -> None:
    command.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE", help=what)


def _add_calibrate(command: argparse.ArgumentParser) -> None:
    command.add_argument("folder", type=path, help="capture folder, or a folder with calibration/extrinsic/")
    what = "calibrate from footage of a board (default), or from the person in the capture"
    command.add_argument("--from", dest="source", choices=("boards", "person"), default="boards", help=what)
    _add_out(command, "cameras")
    what = "also write this format; may be repeated"
    command.add_argument("--format", choices=CAMERA_FORMATS, action="append", default=[], help=what)
    boards = command.add_argument_group("from boards")
    what = "frame in which the board lies on the floor: the world's origin"
    boards.add_argument("--ground-frame", type=number(int, 0, MAX_COUNT), metavar="N", help=what)
    person = command.add_argument_group("from the person")
    what = "the person's height (default: stature_m of capture.toml, else 1.65)"
    person.add_argument("--height", type=number(float, *STATURE_M), metavar="M", help=what)
    person.add_argument("--lens", type=path, metavar="FILE", help="intrinsics: intri.yml, or a TOML file")
    what = "field of view across the longer side (default: metadata, else estimated)"
    person.add_argument("--fov", type=number(float, 1, 170), metavar="DEG", help=what)


def _add_subject(command: argparse.ArgumentParser, verb: str) -> None:
    command.add_argument("subject", type=path, help=FOLDERS["subject"])
    what = f"{verb} this motion: {MOTIONS}"
    command.add_argument("--motion", type=path, action="append", default=[], metavar="FILE", help=what)


def _add_view(view: argparse.ArgumentParser) -> None:
    _add_subject(view, "offer")
    what = "address to serve at; 0.0.0.0 lets the whole network see the person (default: 127.0.0.1)"
    view.add_argument("--host", default="127.0.0.1", help=what)
    view.add_argument("--port", type=number(int, 1, 65535), default=8080, help="port to serve at (default: 8080)")


def _add_export(export: argparse.ArgumentParser) -> None:
    _add_subject(export, "add")
    what = "add FBX and Alembic; PROGRAM is Blender, or a Python that has bpy"
    export.add_argument("--blender", metavar="PROGRAM", help=what)
    what = "accept an asset that is more than 4 dB below its field"
    export.add_argument("--allow-poor", action="store_true", help=what)
    _add_out(export, "asset")
    _add_overrides(export, "override a setting under `asset.`")


def _add_out(command: argparse.ArgumentParser, default: str) -> None:
    command.add_argument("--out", type=path, default=default, help=f"new folder to write (default: {default})")


def _add_study(command: argparse.ArgumentParser, default: str, folder: str, needs: str) -> None:
    study = command.add_mutually_exclusive_group()
    what = f"study of configs/{folder}/, or a YAML file (default: {default}, which needs {needs})"
    study.add_argument("--study", default=default, help=what)
    what = "the study `quick`, about 15 minutes"
    study.add_argument("--quick", dest="study", action="store_const", const="quick", help=what)


def _add_benchmark(benchmark: argparse.ArgumentParser) -> None:
    _add_study(benchmark, "dynamic", "benchmark", "a GPU")
    what = "presets or YAML files to compare, like fast,nerf (default: the study's)"
    benchmark.add_argument("--methods", type=_names, metavar="LIST", help=what)
    what = "time limit of each training, without its tuning of new poses (default: the study's)"
    benchmark.add_argument("--seconds", type=number(float, 0.1, 1_000_000), metavar="S", help=what)


def _add_ablate(ablations: argparse.ArgumentParser) -> None:
    _add_overrides(ablations, "override a setting in all rows")
    what = "only these rows, named as in configs/ablations/"
    ablations.add_argument("--only", nargs="+", default=[], metavar="NAME", help=what)


def _add_stability(stability: argparse.ArgumentParser) -> None:
    _add_study(stability, "full", "stability", "a GPU and days")
    what = "presets, like fast,nerf (default: the study's)"
    stability.add_argument("--methods", type=_names, default=[], metavar="LIST", help=what)
    stability.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only these degradations of the study")


def _names(text: str) -> list[str]:
    names = [stripped for name in text.split(",") if (stripped := name.strip())]
    if not names:
        raise argparse.ArgumentTypeError("give one name or more")
    return names


def _add_render(render: argparse.ArgumentParser) -> None:
    render.add_argument("subject", type=path, help=FOLDERS["subject"])
    _add_out(render, "pictures")
    what = f"one or more of {','.join(PICTURES)} (default: colour)"
    render.add_argument("--what", type=_names, default="colour", metavar="LIST", help=what)
    view = render.add_mutually_exclusive_group()
    view.add_argument("--camera", help="look through this recorded camera (default: an orbit)")
    view.add_argument("--path", type=path, help="fly along these cameras: a JSON list, or a folder")
    what = "radius of the orbit (default: that of the recorded cameras)"
    render.add_argument("--radius", type=number(float, 0.1, MAX_M), metavar="M", help=what)
    what = "height above the person's middle (default: that of the recorded cameras)"
    render.add_argument("--height", type=number(float, -MAX_M, MAX_M), metavar="M", help=what)
    what = f"show this motion: {MOTIONS} (default: the captured one)"
    render.add_argument("--motion", type=path, metavar="FILE", help=what)
    what = "frames to show, or one number (default: all)"
    render.add_argument("--frames", default=":", metavar="FIRST:END:STEP", help=what)
    what = "interpolate between the poses of two frames"
    render.add_argument("--between", nargs=2, type=number(int, 0, MAX_COUNT), metavar="FRAME", help=what)
    what = "add X to a shape value of the body; may be repeated"
    render.add_argument("--shape", action="append", default=[], metavar="NAME=+X", help=what)
    what = "change the body's volume by this, like -40 or 80"
    render.add_argument("--volume", type=number(float, -100, 1000), metavar="PERCENT", help=what)
    what = "longest side of an image (default: that of the capture)"
    render.add_argument("--size", type=number(int, *SIZES_PX), metavar="PX", help=what)
    what = f"number of images (default: one per pose; {ORBIT_PICTURES} for --between, and for one pose on an orbit)"
    render.add_argument("--pictures", type=number(int, 1, MAX_COUNT), metavar="N", help=what)


if __name__ == "__main__":
    sys.exit(main())

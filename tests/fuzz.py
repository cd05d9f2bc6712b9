"""Damage small captures of every layout, and other untrusted files, at random, and read them:

    python tests/fuzz.py [--cases 10000] [--seed 0]
    python tests/fuzz.py --case 1234                    # one case again, with its traceback

A case passes if the file is read, or refused with an InputError, in at most two seconds and 500 MB. Anything else is a
failure: another exception, a crash of the process, a hang. The exit status is 1 if there was a failure.
"""

import argparse
import collections
import contextlib
import json
import logging
import multiprocessing
import multiprocessing.connection
import os
import random
import re
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(1, str(Path(__file__).parents[1] / "benchmarks"))

import numpy as np
from peak_memory import peak_mib, reset_peak
from PIL import ExifTags, Image

from hnerf.body.bvh import Bvh, read_bvh, write_bvh
from hnerf.capture.capture import write_image
from hnerf.capture.formats.export import write_cameras
from hnerf.capture.ingest import ingest, recognise
from hnerf.capture.uncalibrated import Uncalibrated
from hnerf.config import CaptureSettings, load_settings
from hnerf.errors import InputError
from hnerf.render.motion import _read_amass
from hnerf.render.trajectory import read_camera_path
from tasks.store import Store
from tests.capture import recordings as rec
from tests.capture.formats.test_camera_files import to_binary
from tests.capture.formats.test_peoplesnapshot import write_peoplesnapshot
from tests.capture.formats.test_zjumocap import write_parameters, write_zju

MAX_SECONDS, MAX_MIB, HANG_S = 2.0, 477, 20.0
ROOM_BYTES = 3_000_000_000  # more than MAX_MIB: libraries map much memory that they never use
START_S = 60.0  # for a process to start on a busy machine
FRAMES = 2

Read = Callable[[Path, Path], object]  # arguments: the folder to read, and an empty one for results


@dataclass(frozen=True)
class Reader:
    """Code that reads untrusted files. write: fill an empty folder with valid files; read: read that folder."""

    name: str
    write: Callable[[Path], object]
    read: Read


def _ingest(folder: Path, out: Path) -> object:
    return ingest(folder, CaptureSettings(), out)


def _photograph(path: Path, rgb: np.ndarray) -> None:
    """Write a JPEG like one from a phone held upright: stored rotated, with the orientation in its EXIF."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation], exif[ExifTags.Base.Make] = 6, "phone"
    exif[ExifTags.Base.XResolution], exif[ExifTags.IFD.Exif] = 72.0, {ExifTags.Base.FocalLengthIn35mmFilm: 26}
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(np.rot90(rgb)).save(path, exif=exif)


def _easymocap(folder: Path) -> None:
    """Write a full EasyMocap folder: masks, background plates, keypoints of both kinds, capture.toml."""
    rec.write_calibration(folder, distortion=(0.1, 0, 0, 0, 0))
    for camera in rec.CAMERAS:
        for frame in range(FRAMES):
            stem = f"{frame:06d}"
            write_image(folder / "images" / camera / f"{stem}.png", rec.picture(camera, frame))
            write_image(folder / "masks" / camera / f"{stem}.png", np.full((rec.HEIGHT, rec.WIDTH, 3), 255, np.uint8))
        _photograph(folder / "background" / f"{camera}.jpg", rec.picture(camera, 9))
    person = np.tile([4.0, 5.0, 0.5], (25, 1))
    for frame in range(FRAMES):
        rec.write_keypoints(folder / "openpose" / "01" / f"{frame:06d}_keypoints.json", [person])
    results = [{"image_id": f, "keypoints": person.ravel().tolist(), "score": 1.0} for f in range(FRAMES)]
    (folder / "keypoints").mkdir()
    (folder / "keypoints" / "02.json").write_text(json.dumps(results))
    (folder / "capture.toml").write_text(
        'name = "ada"\nfps = 25.0\nup = "z"\nunits = "m"\n[cameras]\ntrain = ["01", "02"]\n[frames]\ntrain = [0, 1]\n'
    )


def _with_cameras(kind: str) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        _easymocap(folder)
        write_cameras(folder, list(recognise(folder).lenses().values()), kind)
        for name in ("intri.yml", "extri.yml", "capture.toml"):
            (folder / name).unlink()
        if kind == "caliscope":
            for part in ("images", "masks", "openpose"):
                for i, camera in enumerate(rec.CAMERAS):
                    with contextlib.suppress(FileNotFoundError):
                        (folder / part / camera).rename(folder / part / f"cam_{i}")

    return write


def _colmap_binary(folder: Path) -> None:
    _with_cameras("colmap")(folder)
    to_binary(folder / "sparse" / "0")


def _boards(folder: Path) -> None:
    """Write a recording with calibration-board footage, with Caliscope's file names."""
    _with_cameras("caliscope")(folder)
    for camera in ("cam_0", "cam_1"):
        for frame in range(FRAMES):
            path = folder / "calibration" / "extrinsic" / camera / f"{frame}.png"
            write_image(path, rec.picture("01", frame))
    rows = ["sync_index,cam_id,frame_time", *(f"{f},{c},{f}.0" for f in range(FRAMES) for c in range(2))]
    (folder / "calibration" / "extrinsic" / "timestamps.csv").write_text("\n".join(rows))
    (folder / "charuco.toml").write_text(
        'columns = 4\nrows = 5\nboard_height = 10.0\nboard_width = 8.0\ndictionary = "DICT_4X4_50"\nunits = "cm"\n'
        "aruco_scale = 0.75\nsquare_size_override_cm = 5.4\ninverted = false\n"
    )


def _zju(folder: Path) -> None:
    write_zju(folder)
    write_parameters(folder / "new_params" / "0.npy", np.zeros(72))


def _videos(folder: Path) -> None:
    rec.write_video(folder / "ada.mp4", FRAMES, (32, 32))
    text = 'field_of_view_deg = 60.0\nsubject = "nearest to (10, 20) in ada at frame 1"\nfps = 25\n'
    (folder / "capture.toml").write_text(text)


def _uncalibrated(folder: Path) -> None:
    _easymocap(folder)
    (folder / "extri.yml").unlink()


def _motion(folder: Path) -> None:
    np.savez_compressed(folder / "a.npz", poses=np.ones((3, 156)), trans=np.zeros((3, 3)), mocap_framerate=120.0)


def _bvh(folder: Path) -> None:
    offsets, turns = np.eye(3)[:2], np.tile(np.eye(3), (2, 2, 1, 1))
    write_bvh(folder / "a.bvh", Bvh(("arm", "fore"), np.array([-1, 0]), offsets, 0.04, turns[..., 0], turns), offsets)


def _camera_path(folder: Path) -> None:
    camera = {"K": rec.K, "R": np.eye(3).tolist(), "t_m": [0, 0, 3], "size_px": [24, 16]}
    (folder / "path.json").write_text(json.dumps([camera, camera]))


def _preset(folder: Path) -> None:
    text = "based_on: fast\ntraining:\n  steps: 100\n  field: {width: 16}\ncapture:\n  max_frames: 10\n"
    (folder / "mine.yaml").write_text(text)


def _store(folder: Path) -> None:
    Store(folder).get_or_compute("fit", "k", lambda out: {"letters": float((out / "a").write_text("abc"))})
    (folder / "fit" / "k.lock").unlink()


READERS = (
    Reader("easymocap", _easymocap, _ingest),
    Reader("pose2sim", rec.write_pose2sim, _ingest),
    Reader("colmap text", _with_cameras("colmap"), _ingest),
    Reader("colmap binary", _colmap_binary, _ingest),
    Reader("caliscope", _boards, _ingest),
    Reader("aniposelib", _with_cameras("aniposelib"), _ingest),
    Reader("zju-mocap", _zju, _ingest),
    Reader("peoplesnapshot", lambda folder: write_peoplesnapshot(folder, FRAMES, (32, 32)), _ingest),
    Reader("videos", _videos, _ingest),
    Reader("uncalibrated", _uncalibrated, lambda at, out: ingest(at, CaptureSettings(), out, Uncalibrated(at))),
    Reader("motion", _motion, lambda folder, out: _read_amass(folder / "a.npz")),
    Reader("bvh", _bvh, lambda folder, out: read_bvh(folder / "a.bvh")),
    Reader("camera path", _camera_path, lambda folder, out: read_camera_path(folder / "path.json", (24, 16))),
    Reader("preset", _preset, lambda folder, out: load_settings(str(folder / "mine.yaml"))),
    Reader("store", _store, lambda folder, out: Store(folder).find("fit", "k")),
)

TOKENS = (
    b"nan", b"-inf", b"1e308", b"1e-300", b"-1", b"9" * 5000, b"\x00", b"\x1b[2J", b"[", b"]", b"{", b"[" * 3000,
    b"null", b"true", b"\xff\xff\xff\xff", b"\x00\x00\x00\x80", b"\xff\xfe", b"../", b"&a [*a]", b"!!int", b"a." * 2000,
    b"\n", b'"', b"'''", b"#", b"<<: ", b"%YAML", b"\xe2\x80\xae", b"a" * 200_000, b"=", b",",
    b"- ", b": ", b"(", b"1" * 400,
)  # fmt: skip
NUMBER = re.compile(rb"-?\d+(\.\d*)?(e[+-]?\d+)?")


def damaged(data: bytes, others: list[bytes], rng: random.Random) -> tuple[str, bytes]:
    """Damage a file's bytes; return the kind of damage and the new bytes. others: the contents of other files."""
    at, length = rng.randrange(len(data) + 1), rng.choice((1, 2, 4, 8, 64, 1024))
    token = rng.choice(TOKENS)
    numbers = [found.span() for found in NUMBER.finditer(data[:20_000])] or [(at, at)]
    start, end = rng.choice(numbers)
    flipped = bytearray(data)
    for _ in range(rng.choice((1, 1, 4, 16)) if data else 0):
        flipped[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    other = rng.choice(others)
    return rng.choice((
        ("bits flipped", bytes(flipped)),
        ("random bytes", data[:at] + rng.randbytes(length) + data[at + length :]),
        ("cut short", data[:at]),
        ("a piece lost", data[:at] + data[at + length :]),
        ("a piece twice", data[: at + length] + data[at:]),
        ("token put in", data[:at] + token + data[at:]),
        ("token in place", data[:at] + token + data[at + len(token) :]),
        ("another number", data[:start] + token + data[end:]),
        ("a piece of another file", data[:at] + other[:length] + data[at + length :]),
        ("another file", other),
        ("empty", b""),
    ))  # fmt: skip


def replace(path: Path, rng: random.Random) -> str:
    """Remove a file or put something other than a regular file in its place; return what was done."""
    path.unlink()
    done = rng.choice(("missing", "a folder", "a pipe", "a link", "a device"))
    if done == "a folder":
        path.mkdir()
    elif done == "a pipe":
        os.mkfifo(path)
    elif done != "missing":
        path.symlink_to("/etc/hostname" if done == "a link" else "/dev/zero")
    return done


class Workshop:
    """Valid folders for all readers; each case damages one file in one of them, and restores it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (mapped + ROOM_BYTES,) * 2)  # raise MemoryError before the machine swaps
        logging.disable(logging.CRITICAL)
        for reader in READERS:
            (root / reader.name).mkdir()
            reader.write(root / reader.name)
        self.files = {r.name: sorted(p for p in (root / r.name).rglob("*") if p.is_file()) for r in READERS}
        for reader in READERS:  # undamaged folders must be readable
            reader.read(root / reader.name, root / "out")
            shutil.rmtree(root / "out", ignore_errors=True)
        self.content = {path: path.read_bytes() for paths in self.files.values() for path in paths}

    def try_case(self, seed: int, case: int) -> tuple[str, str | None]:
        """Run a case; return its description, and a description of its failure or None."""
        rng = random.Random(f"{seed} {case}")
        reader = READERS[case % len(READERS)]
        path = rng.choice(self.files[reader.name])
        if rng.random() < 0.03:
            done = replace(path, rng)
        else:
            done, data = damaged(self.content[path], list(self.content.values()), rng)
            path.write_bytes(data)
        what = f"case {case}: {path.relative_to(self.root)}: {done}"
        out = self.root / "out"
        reset_peak()
        before_mib, began = peak_mib(), time.perf_counter()
        failure = None
        try:
            reader.read(self.root / reader.name, out)
        except InputError as error:
            if "\n" in str(error) or not str(error).isprintable():
                failure = "the message is not one printable line"
        except Exception as error:
            failure = f"{type(error).__name__}: {str(error)[:200]}\n{traceback.format_exc()}"
        seconds, grown_mib = time.perf_counter() - began, peak_mib() - before_mib
        if seconds > MAX_SECONDS:
            failure = f"{failure or ''} took {seconds:.1f} s"
        if grown_mib > MAX_MIB:
            failure = f"{failure or ''} took {grown_mib} MiB"
        shutil.rmtree(out, ignore_errors=True)
        self._mend(path)
        return what, failure

    def _mend(self, path: Path) -> None:
        if path.is_dir() and not path.is_symlink():
            path.rmdir()
        path.unlink(missing_ok=True)
        path.write_bytes(self.content[path])


def _work(root: Path, seed: int, cases: range, results: multiprocessing.connection.Connection) -> None:
    """Run cases; report each one before and after it runs."""
    workshop = Workshop(root)
    for case in cases:
        results.send((case, None, None))
        what, failure = workshop.try_case(seed, case)
        results.send((case, what, failure))


@dataclass(frozen=True)
class Outcome:
    """The number of cases that ran, and descriptions of the failures."""

    cases: int
    failures: list[str]


def fuzz(cases: int, seed: int = 0) -> Outcome:
    """Run cases in a child process. A crash or a hang is a failure of the case that was running, and a new process goes
    on with the next one."""
    failures, case, tried = [], 0, 0
    spawn = multiprocessing.get_context("spawn")
    while case < cases:
        with tempfile.TemporaryDirectory(prefix="hnerf-fuzz-") as root:
            receive, send = spawn.Pipe(duplex=False)
            worker = spawn.Process(target=_work, args=(Path(root), seed, range(case, cases), send), daemon=True)
            worker.start()
            send.close()
            try:
                while True:
                    if not receive.poll(HANG_S + START_S):
                        failures.append(f"case {case}: hangs")
                        break
                    case, what, failure = receive.recv()
                    if what:
                        tried, case = tried + 1, case + 1
                        failures += [f"{what}: {failure}"] if failure else []
            except EOFError:
                worker.join()
                if worker.exitcode:
                    failures.append(f"case {case}: the process ended with {worker.exitcode}")
            if worker.is_alive():
                worker.kill()
                worker.join()
            case += worker.exitcode != 0
    return Outcome(tried, failures)


def main() -> int:
    """Run the requested cases; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", type=int, help="try this one alone")
    asked = parser.parse_args()
    if asked.case is not None:
        with tempfile.TemporaryDirectory(prefix="hnerf-fuzz-") as root:
            what, failure = Workshop(Path(root)).try_case(asked.seed, asked.case)
        print(what, failure or "is good", sep="\n")
        return 1 if failure else 0
    began = time.monotonic()
    found = fuzz(asked.cases, asked.seed)
    for failure in found.failures:
        print(failure, flush=True)
    kinds = collections.Counter(failure.split(": ")[-1].splitlines()[0][:60] for failure in found.failures)
    print(f"{found.cases} cases in {time.monotonic() - began:.0f} s, {len(found.failures)} failures", *kinds.items())
    return 1 if found.failures else 0


if __name__ == "__main__":
    sys.exit(main())

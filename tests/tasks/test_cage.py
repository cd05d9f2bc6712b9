import ctypes
import logging
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest

from hnerf.config import LimitSettings
from hnerf.errors import InputError, PlaceError
from hnerf.progress import Progress, listening, report
from tasks.cage import CLONE_NEWNET, CLONE_NEWUSER, run_caged
from tasks.launcher import LostWorkerError
from tasks.limits import StalledError, limited, set_limits

HERE = Path(__file__).parents[2]
WITHOUT_NETWORK = f"import ctypes, sys; sys.exit(bool(ctypes.CDLL(None).unshare({CLONE_NEWUSER | CLONE_NEWNET})))"


@pytest.fixture(autouse=True)
def readers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the reader's process import the functions below."""
    monkeypatch.setenv("PYTHONPATH", str(HERE), prepend=os.pathsep)


def read_first(folder: Path) -> Path:
    """Open a file as readers do, so that errors name it as the last one that was read; return its path."""
    path = folder / "first.bin"
    path.open("rb").close()
    return path


def crashes(folder: Path) -> None:
    read_first(folder)
    ctypes.string_at(0)


def wants_all_memory(folder: Path) -> None:
    read_first(folder)
    bytearray(3 << 29)


def loses_a_process(folder: Path) -> None:
    raise BrokenProcessPool("terminated abruptly")


def never_ends(folder: Path) -> None:
    read_first(folder)
    while True:
        pass


def makes_progress(folder: Path) -> None:
    before_s, _ = resource.getrlimit(resource.RLIMIT_CPU)
    began_s = time.process_time()
    while time.process_time() < began_s + 1.05:  # the limit is in whole seconds
        pass
    report("camera 1", 1, 3)
    assert resource.getrlimit(resource.RLIMIT_CPU)[0] > before_s


def waits(folder: Path) -> None:
    (folder / "reader").write_text(str(os.getpid()))
    time.sleep(60)


def writes_without_end(folder: Path) -> None:
    read_first(folder)
    with tempfile.TemporaryFile() as file:
        file.truncate(1 << 33)
        file.flush()


def opens_everything(folder: Path) -> None:
    path = read_first(folder)
    kept = [path.open("rb") for _ in range(2000)]
    assert kept


def calls_home(folder: Path, port: int) -> None:
    socket.create_connection(("127.0.0.1", port), timeout=5)


def is_killed(folder: Path) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def is_killed_at_work(folder: Path) -> None:
    Path(tempfile.mkdtemp(prefix="hnerf-"), "000000.png").write_text("image")
    is_killed(folder)


def reads(folder: Path, out: Path) -> None:
    logging.getLogger("hnerf.capture").warning("%s: of 2 cameras one is black", read_first(folder))
    report("camera 1", 3, 4)
    print("camera 1: 2 frames")
    os.write(1, b"a library says something")
    out.write_text("read")


def refuses(folder: Path) -> None:
    raise InputError(f"{folder}: no calibration; give one")


def finds_no_space(folder: Path) -> None:
    raise OSError(28, "No space left on device", "/in", None, "/out")


def cannot_write(folder: Path) -> None:
    raise OSError("a.png: cannot be written; is the disk full?")


def lacks_a_network(folder: Path) -> None:
    raise PlaceError("packed.tflite: not there; run `hnerf models`")


def is_wrong(folder: Path) -> None:
    raise KeyError("camera")


def with_first_file(folder: Path) -> Path:
    (folder / "first.bin").touch()
    return folder


def test_logs_progress_output_and_files_of_a_reader_arrive(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    heard: list[Progress] = []
    with listening(heard.append):
        run_caged(reads, with_first_file(tmp_path), tmp_path / "out", folder=tmp_path)
    assert [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING and r.name == "hnerf.capture"] == [
        f"{tmp_path / 'first.bin'}: of 2 cameras one is black"
    ]
    assert capfd.readouterr().out == "camera 1: 2 frames\n"
    assert heard == [Progress("camera 1", 3, 4)] and (tmp_path / "out").read_text() == "read"


@pytest.mark.parametrize(
    ("read", "why"),
    [
        (crashes, r"first.bin: reading it crashed \(SIGSEGV\); export it again"),
        (wants_all_memory, "first.bin: reading it needs more than 1 GiB; export it again, or raise limits.reader_gib"),
        (never_ends, "first.bin: no progress in 0 s of a processor's time; export it again, or raise limits.stage_s"),
        (writes_without_end, "first.bin: what is written of it is too large; export it again"),
        (opens_everything, "first.bin: it needs too many open files; export it again"),
        (refuses, "no calibration; give one"),
    ],
)
def test_a_reader_that_exceeds_a_limit_is_refused_with_the_name_of_the_file(
    read: object, why: str, tmp_path: Path
) -> None:
    set_limits(LimitSettings(stage_s=0.2, image_s=0, reader_gib=1))
    with pytest.raises(InputError, match=f"^{tmp_path}.*{why}$"):
        run_caged(read, with_first_file(tmp_path), folder=tmp_path)


def test_a_reader_that_makes_progress_gets_more_time(tmp_path: Path) -> None:
    run_caged(makes_progress, tmp_path, folder=tmp_path)


def test_errors_of_the_machine_are_retryable_and_bugs_have_a_traceback(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space left on device") as raised:
        run_caged(finds_no_space, tmp_path, folder=tmp_path)
    assert (raised.value.errno, raised.value.filename) == (28, "/out")
    with pytest.raises(OSError, match=r"^a\.png: cannot be written; is the disk full\?$") as raised:
        run_caged(cannot_write, tmp_path, folder=tmp_path)
    assert raised.value.errno is None
    with pytest.raises(LostWorkerError, match="its reader was killed by SIGKILL"):
        run_caged(is_killed, tmp_path, folder=tmp_path)
    with pytest.raises(PlaceError, match="not there; run `hnerf models`"):
        run_caged(lacks_a_network, tmp_path, folder=tmp_path)
    with pytest.raises(RuntimeError, match=r"in is_wrong\n(.*\n)*KeyError: 'camera'"):
        run_caged(is_wrong, tmp_path, folder=tmp_path)


@pytest.mark.skipif(
    subprocess.run([sys.executable, "-c", WITHOUT_NETWORK], check=False).returncode != 0,
    reason="the system lets no process give up its network",
)
def test_a_reader_has_no_network(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, pytest.raises(OSError, match="Network is unreachable"):
        run_caged(calls_home, tmp_path, server.getsockname()[1], folder=tmp_path)


def test_a_killed_reader_leaves_no_temporary_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They may be the images of whole videos."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(LostWorkerError):
        run_caged(is_killed_at_work, tmp_path, folder=tmp_path)
    assert not any(tmp_path.iterdir())


def test_a_stalled_reader_ends_with_its_stage(tmp_path: Path) -> None:
    set_limits(LimitSettings(stage_s=6, image_s=0))
    with pytest.raises(StalledError), limited("capture", 1, resumable=False):
        run_caged(waits, tmp_path, folder=tmp_path)
    assert not Path("/proc", (tmp_path / "reader").read_text()).exists()


def test_a_reader_ends_with_its_run(tmp_path: Path) -> None:
    source = (
        "import sys; from pathlib import Path; from tasks.cage import run_caged; from tests.tasks import test_cage\n"
    )
    source += "run_caged(test_cage.waits, Path(sys.argv[1]), folder=Path(sys.argv[1]))"
    run, noted = subprocess.Popen([sys.executable, "-c", source, str(tmp_path)]), tmp_path / "reader"
    while not noted.exists() or not noted.read_text():
        time.sleep(0.05)
    run.kill()
    run.wait()
    for _ in range(100):
        if not Path("/proc", noted.read_text()).exists():
            return
        time.sleep(0.05)
    pytest.fail("the reader outlived its run")


def test_a_reader_that_loses_a_process_of_its_own_is_retryable(tmp_path: Path) -> None:
    with pytest.raises(LostWorkerError, match="a process of its reader ended: terminated abruptly"):
        run_caged(loses_a_process, tmp_path, folder=tmp_path)

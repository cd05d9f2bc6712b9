import errno
import os
import shutil
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from fsspec import filesystem

from flows import ingest_captures as module
from flows.ingest_captures import ingest_captures
from flows.train_subject import train_subject
from hnerf.errors import InputError, PlaceError
from tasks import ledger, quarantine
from tasks.bucket import VARIABLE, Bucket
from tasks.limits import StalledError
from tasks.source import read_capture

pytestmark = pytest.mark.usefixtures("runs")


@pytest.fixture
def watched(tmp_path: Path) -> Path:
    for name in ("ada", "bob"):
        (tmp_path / "captures" / name / "images").mkdir(parents=True)
        (tmp_path / "captures" / name / "images" / "0.jpg").write_text(f"pixels of {name}")
    return tmp_path / "captures"


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Replace the server by a fake; return the list of the runs that were started."""
    asked: list[dict[str, Any]] = []

    def run_deployment(name: str, parameters: dict[str, Any], **options: Any) -> SimpleNamespace:
        asked.append({"deployment": name, **parameters})
        return SimpleNamespace(id=f"run-{len(asked)}")

    monkeypatch.setattr(module, "run_deployment", run_deployment)
    monkeypatch.setattr(module, "unfinished_runs", lambda: 0)
    monkeypatch.setattr(module, "restart_crashed", lambda _: [])
    return asked


def every_run_is_the_one_that_was_started(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the ledger take runs that tests start by hand for those of the fake server."""

    def release(store: Path, capture: Path | str, _: str) -> None:
        for _, run in ledger.started_from(store, capture):
            ledger.release(store, capture, run)

    monkeypatch.setattr("flows.train_subject.release", release)


def look(watched: Path, settle_s: float = 0.0, max_unfinished: int = 20) -> list[str]:
    return ingest_captures.fn(watched, "demo", watched.parent / "store", settle_s, max_unfinished)


def test_each_capture_is_started_once(watched: Path, runs: list[dict[str, Any]]) -> None:
    assert look(watched) == ["ada", "bob"]
    assert look(watched) == []
    assert runs[0] == {
        "deployment": "train-subject/local",
        "capture": str(watched / "ada"),
        "preset": "demo",
        "store": str(watched.parent / "store"),
    }
    assert [Path(run["capture"]).name for run in runs] == ["ada", "bob"]


def test_a_misspelled_preset_uses_up_no_capture(watched: Path, runs: list[dict[str, Any]]) -> None:
    """Nor does a file that the preset misspells."""
    mine = watched.parent / "mine.yaml"
    mine.write_text("{based_on: fast, fit: {body_model: absent.npz}}")
    for preset, why in (("fsat", "fsat: no such preset"), (str(mine), r"fit\.body_model: absent\.npz: no such file")):
        with pytest.raises(InputError, match=why):
            ingest_captures.fn(watched, preset, watched.parent / "store", 0.0)
    assert not runs and look(watched) == ["ada", "bob"]


def test_a_copy_or_a_new_name_is_the_same_capture_and_changed_content_a_new_one(watched: Path) -> None:
    look(watched)
    shutil.copytree(watched / "ada", watched / "copy of ada")
    (watched / "bob").rename(watched / "robert")
    assert look(watched) == []
    (watched / "ada" / "images" / "0.jpg").write_text("other pixels")
    assert look(watched) == ["ada"]


def test_a_good_file_copied_over_a_damaged_one_of_the_same_size_and_time_is_noticed(watched: Path) -> None:
    """As `cp -p` and `rsync -aI` do."""
    image = watched / "ada" / "images" / "0.jpg"
    os.utime(image, (1, 1))
    assert look(watched) == ["ada", "bob"]
    image.write_text("pixels of eve")
    os.utime(image, (1, 1))
    assert look(watched) == ["ada"]


def test_captures_are_trained_again_after_the_store_was_deleted(watched: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Prefect ignores an idempotency key that it knows. A repeated call after an interruption uses the same key, a new
    store another one."""
    keys: list[str] = []

    def run_deployment(*_: Any, idempotency_key: str, **__: Any) -> SimpleNamespace:
        keys.append(idempotency_key)
        return SimpleNamespace(id=f"run-{len(keys)}")

    monkeypatch.setattr(module, "run_deployment", run_deployment)
    look(watched)
    for record in (watched.parent / "store" / "ingested").iterdir():
        if record.name != "id":  # as if the machine had crashed before these were written
            record.unlink()
    look(watched)
    assert keys[:2] == keys[2:] and len(set(keys)) == 2
    shutil.rmtree(watched.parent / "store")
    look(watched)
    assert len(set(keys)) == 4


def test_folders_being_written_and_hidden_or_empty_folders_are_not_started(watched: Path) -> None:
    shutil.copytree(watched / "ada", watched / ".incoming")
    (watched / "empty").mkdir()
    assert look(watched, settle_s=1000.0) == []
    assert look(watched) == ["ada", "bob"]


@pytest.mark.usefixtures("wrong_clock")
def test_captures_on_a_share_whose_clock_differs_wait_no_longer_or_shorter(watched: Path) -> None:
    assert look(watched, settle_s=60.0) == []
    assert look(watched) == ["ada", "bob"]


def test_a_capture_with_a_hidden_partial_file_waits(watched: Path) -> None:
    """rsync writes to a hidden temporary name."""
    for path in [*watched.rglob("*")]:
        os.utime(path, (0, 0))
    (watched / "bob" / "images" / ".1.jpg.Xa81fQ").write_text("half")
    while time.time() - (watched / "ada" / "images" / "0.jpg").stat().st_ctime < 0.6:
        time.sleep(0.1)
    (watched / "bob" / "images" / ".1.jpg.Xa81fQ").write_text("nearly all")
    assert look(watched, settle_s=0.5) == ["ada"]
    (watched / "bob" / "images" / ".1.jpg.Xa81fQ").unlink()
    assert look(watched, settle_s=0.5) == ["bob"]


def test_a_name_that_is_not_utf_8_or_a_deep_folder_does_not_block_other_captures(watched: Path) -> None:
    shutil.copytree(watched / "ada", watched / os.fsdecode(b"a\xff"))
    (watched / "deep").mkdir()
    at = os.open(watched / "deep", os.O_RDONLY)
    for _ in range(1100):
        os.mkdir("d", dir_fd=at)
        at, above = os.open("d", os.O_RDONLY, dir_fd=at), at
        os.close(above)
    os.close(at)
    started = look(watched)
    subprocess.run(["rm", "-r", watched / "deep"], check=True)  # shutil.rmtree is recursive
    assert started == ["ada", "bob"]
    note = (watched / ".refused" / os.fsdecode(b"a\xff.txt")).read_text()
    assert note.startswith("a\\udcff: refused: ") and "is not UTF-8; rename it" in note
    assert sorted(path.name for path in (watched / ".refused").iterdir()) == [os.fsdecode(b"a\xff.txt")]


def test_a_refused_capture_is_logged_and_noted_until_it_is_changed_or_removed_and_others_are_started(
    watched: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The capture itself is not moved."""
    noted, why = watched / ".refused", "0.jpg: cannot be read; make it readable"

    def unreadable(capture: Path) -> Any:
        if capture.name == "ada":
            raise InputError(why)
        return read_capture(capture)

    with monkeypatch.context() as broken:
        broken.setattr(module, "read_capture", unreadable)
        assert look(watched) == ["bob"]
    assert why in caplog.text and (noted / "ada.txt").read_text().startswith(f"ada: refused: {why}\n")
    (watched / "ada" / "images" / "0.jpg").touch()
    assert look(watched) == ["ada"]
    assert list(noted.iterdir()) == []
    (noted / "gone.txt").touch()
    look(watched)
    assert list(noted.iterdir()) == [] and (watched / "ada" / "images").is_dir()


def test_a_capture_that_cannot_be_read_is_read_again_only_once_it_has_changed_or_after_an_hour(
    watched: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Its reason stands, in the log and in its note."""
    reads, why = (
        Mock(side_effect=OSError(errno.EIO, "Input/output error", "0.jpg")),
        "[Errno 5] Input/output error: '0.jpg'",
    )
    monkeypatch.setattr(module, "read_capture", reads)
    shutil.rmtree(watched / "bob")

    def reads_so_far() -> int:
        assert look(watched) == [] and caplog.messages[-1] == why
        assert (watched / ".refused" / "ada.txt").read_text().startswith(f"ada: refused: {why}\n")
        return reads.call_count

    assert (reads_so_far(), reads_so_far()) == (1, 1)
    (noted,) = (watched.parent / "store" / "ingested").glob("refused-*")
    os.utime(noted, (0, 0))
    assert (reads_so_far(), reads_so_far()) == (2, 2)
    (watched / "ada" / "images" / "0.jpg").touch()
    assert reads_so_far() == 3


@pytest.mark.parametrize("character", [b"x", "\u8a18".encode(), "\U0001f600".encode(), b"\xff"])
def test_a_capture_with_a_long_name_has_a_note_too(character: bytes, watched: Path) -> None:
    name = os.fsdecode(character * (255 // len(character)))
    others = [watched / "ada", watched / f"{name[:-1]}y"]
    for capture in (*others, watched / name):
        capture.mkdir(exist_ok=True)
        quarantine.note(capture, "refused: x")
    quarantine.clear_removed(watched)
    assert len(list(watched.glob(".refused/*.txt"))) == 3
    quarantine.clear(watched / name)
    assert len(list(watched.glob(".refused/*.txt"))) == 2
    (watched / f"{name[:-1]}y").rmdir()
    quarantine.clear_removed(watched)
    assert [path.name for path in watched.glob(".refused/*.txt")] == ["ada.txt"]


def test_notes_are_not_written_through_links(watched: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (watched / ".refused").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "thesis.txt").touch()
    quarantine.clear_removed(watched)
    (tmp_path / "elsewhere" / "thesis.txt").unlink()  # raises if it is missing
    with pytest.raises(OSError, match="is a symbolic link"):
        quarantine.note(watched / "ada", "refused: x")
    (watched / ".refused").unlink()
    quarantine.note(watched / "ada", "refused: x")
    (watched / ".refused" / "ada.txt").unlink()
    (watched / ".refused" / "ada.txt").symlink_to(tmp_path / "elsewhere" / "file")
    quarantine.note(watched / "ada", "refused: y")
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_a_run_that_was_lost_too_often_is_noted_in_its_watched_folder(
    watched: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    look(watched)
    elsewhere = watched.parent / "elsewhere" / "ada"
    elsewhere.mkdir(parents=True)
    lost = [SimpleNamespace(name="ada", id="1", parameters={"capture": str(c)}) for c in (watched / "ada", elsewhere)]
    monkeypatch.setattr(module, "restart_crashed", lambda _: [(run, "lost 4 times") for run in lost])
    look(watched)
    assert (watched / ".refused" / "ada.txt").read_text().startswith("ada: failed: lost 4 times (flow run ada, 1)\n")
    assert [path.name for path in watched.glob(".refused/*")] == ["ada.txt"]
    assert list(elsewhere.parent.iterdir()) == [elsewhere]  # it was not started from a watched folder


def test_a_failed_run_is_noted_in_its_watched_folder(watched: Path, prefect_api: str) -> None:
    store = watched.parent / "store"
    for expected in ([], ["ada.txt"]):  # before and after the watch has started it
        with pytest.raises(InputError):
            train_subject(watched / "ada", store=store)
        assert sorted(path.name for path in watched.glob(".refused/*")) == expected
        look(watched)
    text = (watched / ".refused" / "ada.txt").read_text()
    assert text.startswith(f"ada: refused: {watched / 'ada'}: ") and "(flow run " in text


def test_a_fault_of_the_machine_uses_up_no_capture_and_is_not_held_against_it(
    watched: Path, monkeypatch: pytest.MonkeyPatch, prefect_api: str
) -> None:
    """The worker's bucket is not there. After three more runs the capture is kept: no machine can train it."""
    store = watched.parent / "store"
    look(watched)
    every_run_is_the_one_that_was_started(monkeypatch)
    for again in (["ada"], ["ada"], ["ada"], []):
        with monkeypatch.context() as misconfigured, pytest.raises(PlaceError):
            misconfigured.setenv(VARIABLE, f"file://{watched}/unmade")
            train_subject(watched / "ada", store=store)
        text = (watched / ".refused" / "ada.txt").read_text()
        assert text.startswith(f"ada: failed: {VARIABLE}: ") and "refused" not in text and "not to blame" in text
        assert look(watched) == again


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES, errno.ENOENT])
@pytest.mark.parametrize(("place", "again"), [("captures/ada/images/0.jpg", []), ("home/.cache/warp", ["ada"])])
def test_only_a_file_of_the_capture_itself_is_held_against_it(
    number: int, place: str, again: list[str], watched: Path, monkeypatch: pytest.MonkeyPatch, prefect_api: str
) -> None:
    """A cache may be missing, forbidden, or on a disk that became read-only."""
    every_run_is_the_one_that_was_started(monkeypatch)
    look(watched)
    unusable = OSError(number, os.strerror(number), str(watched.parent / place))
    with monkeypatch.context() as patch, pytest.raises(OSError, match=place):
        patch.setattr("flows.train_subject.train_avatar", Mock(side_effect=unusable))
        train_subject(watched / "ada", store=watched.parent / "store")
    assert ("Correct the folder" in (watched / ".refused" / "ada.txt").read_text()) == (again == [])
    assert look(watched) == again


def test_a_capture_whose_stage_stalled_is_not_started_again(
    watched: Path, monkeypatch: pytest.MonkeyPatch, prefect_api: str
) -> None:
    every_run_is_the_one_that_was_started(monkeypatch)
    look(watched)
    with monkeypatch.context() as patch, pytest.raises(StalledError):
        patch.setattr(
            "flows.train_subject.train_avatar", Mock(side_effect=StalledError("detection: no progress", True))
        )
        train_subject(watched / "ada", store=watched.parent / "store")
    assert "not to blame, repeat" in (watched / ".refused" / "ada.txt").read_text() and look(watched) == []


def test_a_bucket_that_is_not_there_uses_up_no_capture(
    watched: Path, runs: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as misconfigured, pytest.raises(PlaceError, match="unmade is not there; make it"):
        misconfigured.setenv(VARIABLE, f"file://{watched}/unmade")
        look(watched)
    assert not runs and look(watched) == ["ada", "bob"]


def test_nothing_is_started_if_the_disk_is_nearly_full(
    watched: Path, runs: list[dict[str, Any]], caplog: pytest.LogCaptureFixture
) -> None:
    full = ingest_captures.fn(watched, "demo", watched.parent / "store", 0.0, min_free_gib=1e9)
    assert full == runs == [] and "nothing is started" in caplog.text


def test_checking_many_known_folders_is_quick(watched: Path) -> None:
    """For a hundred folders; a thousand take ten times as long (docs/reliability.md)."""
    for i in range(98):
        (watched / f"c{i}").mkdir()
        for j in range(10):
            (watched / f"c{i}" / f"{j}.jpg").write_text(f"{i} {j}")
    assert len(look(watched, max_unfinished=1000)) == 100
    before_s = time.process_time()
    assert look(watched) == []
    assert time.process_time() - before_s < 0.5


def test_a_folder_renamed_while_its_run_waits_is_trained_under_its_new_name(
    watched: Path, runs: list[dict[str, Any]]
) -> None:
    """The waiting run does not find its folder, and releases the capture; the other capture is not started again."""
    look(watched)
    (watched / "ada").rename(watched / "eve")
    assert look(watched) == []  # it is not known yet whether that run has begun
    with pytest.raises(InputError, match="ada: no such folder"):
        train_subject.fn(Path(runs[0]["capture"]), "demo", watched.parent / "store")
    assert look(watched) == ["eve"]
    assert runs[-1]["capture"] == str(watched / "eve") and look(watched) == []


def test_a_folder_renamed_while_it_is_read_is_trained_under_its_new_name(
    watched: Path, runs: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def read(*_: object, **__: object) -> None:
        (watched / "ada").rename(watched / "eve")
        raise InputError("0.jpg: image missing")

    look(watched)
    monkeypatch.setattr("tasks.cage.run_caged", read)
    with pytest.raises(InputError, match="ada: changed or moved since the command started"):
        train_subject.fn(Path(runs[0]["capture"]), "demo", watched.parent / "store")
    assert look(watched) == ["eve"]


def test_no_more_runs_are_started_than_the_limit(
    watched: Path, runs: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    for i in range(5):
        shutil.copytree(watched / "ada", watched / f"new{i}")
        (watched / f"new{i}" / "images" / "0.jpg").write_text(str(i))
    monkeypatch.setattr(module, "unfinished_runs", lambda: len(runs))
    assert look(watched, max_unfinished=3) == ["ada", "bob", "new0"]
    assert look(watched, max_unfinished=3) == []
    del runs[:2]  # these have ended
    assert look(watched, max_unfinished=3) == ["new1", "new2"]


def test_captures_beyond_the_limit_are_not_read(watched: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise every look would read it again, which takes minutes."""
    reads = Mock(side_effect=read_capture)
    monkeypatch.setattr(module, "read_capture", reads)
    monkeypatch.setattr(module, "unfinished_runs", lambda: 2)
    assert look(watched, max_unfinished=2) == [] and reads.call_count == 0
    assert look(watched, max_unfinished=3) == ["ada"] and reads.call_count == 1


def test_links_out_of_the_folder_are_not_followed(watched: Path, caplog: pytest.LogCaptureFixture) -> None:
    (watched / "ada").rename(watched.parent / "elsewhere")
    (watched / "ada").symlink_to(watched.parent / "elsewhere")
    assert look(watched) == ["bob"]
    assert "ada: is a symbolic link and not followed" in caplog.text


@pytest.mark.parametrize(("name", "room"), [(b"a\xff", 0), (b"a\x1b", 20)])
def test_names_that_are_not_printable_are_escaped_in_the_log(
    name: bytes, room: int, watched: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The server drops all records of a moment if one is not UTF-8."""
    shutil.rmtree(watched / "bob")
    (watched / "ada").rename(watched / os.fsdecode(name))
    (watched / os.fsdecode(b"0\xff")).symlink_to(watched)
    look(watched, max_unfinished=room)
    assert len(caplog.messages) == 2 and all(message.isprintable() for message in caplog.messages)


def test_runs_are_given_the_folders_by_the_names_that_other_machines_know(
    watched: Path, runs: list[dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a container, which mounts what is at ./captures and ./store, wherever links lead on this machine."""
    (tmp_path / "disk").mkdir()
    (tmp_path / "checkout").mkdir()
    monkeypatch.chdir(tmp_path / "checkout")
    Path("captures").symlink_to(watched)
    Path("store").symlink_to(tmp_path / "disk")
    assert ingest_captures.fn(Path("captures"), "demo", Path("store"), 0.0) == ["ada", "bob"]
    assert runs[0]["capture"] == str(tmp_path / "checkout" / "captures" / "ada")
    assert runs[0]["store"] == str(tmp_path / "checkout" / "store")
    with pytest.raises(InputError, match="no such folder"):
        (watched / "ada").rename(watched / "eve")
        train_subject.fn(Path(runs[0]["capture"]), "demo", Path("store"))
    assert ingest_captures.fn(Path("captures"), "demo", Path("store"), 0.0) == ["eve"]


def test_names_that_are_not_utf_8_are_captures_too(watched: Path) -> None:
    (watched / "ada" / os.fsdecode(b"caf\xe9.txt")).touch()
    assert look(watched) == ["ada", "bob"]


def test_a_failed_start_is_repeated_at_the_next_look(watched: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as broken:
        broken.setattr(module, "run_deployment", Mock(side_effect=ConnectionError("no server")))
        with pytest.raises(ConnectionError):
            look(watched)
    assert look(watched) == ["ada", "bob"]


@pytest.fixture
def bucket(s3: str, tmp_path: Path) -> str:
    """Return the URL of a folder in a bucket with the captures ada and bob."""
    url = f"{s3}-{tmp_path.name}"
    for name in ("ada", "bob"):
        filesystem("s3").pipe(f"{url}/{name}/a.mp4", name.encode())
    return url


def test_captures_in_a_bucket_are_started_by_their_url(bucket: str, tmp_path: Path, runs: list[dict[str, Any]]) -> None:
    """A capture starts once its listing has stopped changing. A copy is the same capture, changed content a new one."""
    fs, store = filesystem("s3"), tmp_path / "store"
    assert ingest_captures.fn(bucket, "demo", store, 60.0) == []
    (waiting, _) = (store / "ingested").glob("new-*")
    os.utime(waiting, (time.time() - 61,) * 2)
    (one,) = ingest_captures.fn(bucket, "demo", store, 60.0)
    (other,) = ingest_captures.fn(bucket, "demo", store, 0.0)
    assert {one, other} == {"ada", "bob"}
    (store / "ingested" / "new-seen-half").touch()
    os.utime(store / "ingested" / "new-seen-half", (0, 0))  # of an upload that has grown since
    assert ingest_captures.fn(bucket, "demo", store, 0.0) == []
    assert {run["capture"] for run in runs} == {f"{bucket}/ada", f"{bucket}/bob"}
    assert not list((store / "ingested").glob("new-*"))
    fs.copy(f"{bucket}/ada/a.mp4", f"{bucket}/copy of ada/a.mp4")
    assert ingest_captures.fn(bucket, "demo", store, 0.0) == []
    fs.pipe(f"{bucket}/ada/a.mp4", b"eve")
    assert ingest_captures.fn(bucket, "demo", store, 0.0) == ["ada"]


def test_a_capture_moved_within_the_bucket_is_started_from_its_new_url(bucket: str, tmp_path: Path) -> None:
    store = tmp_path / "store"
    assert ingest_captures.fn(bucket, "demo", store, 0.0) == ["ada", "bob"]
    filesystem("s3").mv(f"{bucket}/ada/a.mp4", f"{bucket}/adele/a.mp4")
    with pytest.raises(InputError, match="ada: no such folder"):
        train_subject.fn(f"{bucket}/ada", "demo", store)
    assert ingest_captures.fn(bucket, "demo", store, 0.0) == ["adele"]


@pytest.mark.parametrize(("error", "again"), [(PlaceError("403"), ["ada"]), (InputError("no ETag"), [])])
def test_a_run_without_access_to_the_bucket_uses_up_no_capture(
    error: InputError, again: list[str], bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, prefect_api: str
) -> None:
    store = tmp_path / "store"
    every_run_is_the_one_that_was_started(monkeypatch)
    assert ingest_captures.fn(bucket, "demo", store, 0.0) == ["ada", "bob"]

    with monkeypatch.context() as patch, pytest.raises(InputError, match=str(error)):
        patch.setattr(Bucket, "files", Mock(side_effect=error))
        train_subject(f"{bucket}/ada", "demo", store)
    assert ingest_captures.fn(bucket, "demo", store, 0.0) == again

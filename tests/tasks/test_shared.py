import errno
import multiprocessing
import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from fsspec.implementations.memory import MemoryFileSystem

from hnerf.errors import InputError
from hnerf.files import replace_text
from tasks import lease, packed, shared_checkpoint
from tasks.bucket import Bucket, BucketError
from tasks.garbage import find_garbage
from tasks.inventory import Inventory
from tasks.shared import get_or_compute
from tasks.store import Artifact, Store
from tasks.verify import faults

SPAWN = multiprocessing.get_context("spawn")
KEY = f"{7:032x}"
OBJECT = f"fit/{KEY}.tar"
CHECKPOINT = f"training/{KEY}.checkpoint"


@pytest.fixture(params=["file", "memory", "s3"])
def bucket(request: pytest.FixtureRequest, tmp_path: Path) -> Bucket:
    """Return an empty bucket."""
    if request.param == "s3":
        return Bucket.at(f"{request.getfixturevalue('s3')}/{tmp_path.name}")
    if request.param == "memory":
        MemoryFileSystem.store.clear()
        MemoryFileSystem().makedirs("/share", exist_ok=True)
        return Bucket.at("memory://share")
    return disk_bucket(tmp_path)


def disk_bucket(tmp_path: Path) -> Bucket:
    (tmp_path / "bucket").mkdir(exist_ok=True)
    return Bucket.at(f"file://{tmp_path}/bucket")


def write(out: Path) -> dict[str, float]:
    (out / "deep").mkdir(exist_ok=True)
    (out / "deep" / "letters").write_text("abc")
    (out / "again").write_text("abc")
    return {"letters": 3.0}


def made(bucket: Bucket, store: Store, work: Callable[[Path], dict[str, float]] = write) -> Artifact:
    """Get or compute the artifact `fit/KEY`, which was computed from another one."""
    inputs = [f"capture/{1:032x}"]
    return get_or_compute(bucket, store, "fit", KEY, lambda: store.get_or_compute("fit", KEY, work, inputs=inputs))


def never(out: Path) -> dict[str, float]:
    raise AssertionError("was to be found in the bucket")


def clean(store: Store) -> bool:
    return not faults(store).lines and not find_garbage(Inventory.of(store), 1, 0)[1:]


def test_one_machine_uses_the_artifact_of_another(bucket: Bucket, tmp_path: Path) -> None:
    here, there = Store(tmp_path / "here"), Store(tmp_path / "there")
    first, second = made(bucket, here), made(bucket, there, never)
    assert second.root == there.path("fit", KEY)
    assert second.model_dump(exclude={"root"}) == first.model_dump(exclude={"root"})
    assert (second.root / "deep" / "letters").read_text() == "abc"
    assert clean(here) and clean(there)
    assert bucket.read_note(f"fit/{KEY}.lease.0") is None
    assert made(bucket, here, never) == first


def damage(bucket: Bucket, change: Callable[[bytes], bytes]) -> None:
    path = f"{bucket.root}/{OBJECT}"
    bucket.fs.pipe_file(path, change(bucket.fs.cat_file(path)))


@pytest.mark.parametrize(
    "change",
    [
        lambda whole: b"",
        lambda whole: whole[:700],
        lambda whole: whole[: whole.index(b"abc")],
        lambda whole: whole.replace(b"\0abc\0", b"\0abd\0"),
        lambda whole: whole.replace(b'"letters":3', b'"letters":4'),
        lambda whole: whole.replace(b"deep/letters", b"../../letter"),
        lambda whole: b"\x80\x04cposix\nsystem\n" * 99,
    ],
)
def test_a_damaged_object_is_refused_and_computed_again(
    tmp_path: Path, change: Callable[[bytes], bytes], caplog: pytest.LogCaptureFixture
) -> None:
    bucket = disk_bucket(tmp_path)
    made(bucket, Store(tmp_path / "here"))
    damage(bucket, change)
    store = Store(tmp_path / "there")
    assert made(bucket, store).metrics == {"letters": 3.0}
    assert f"{OBJECT}: " in caplog.text and "(fit is computed again)" in caplog.text
    assert clean(store)
    made(bucket, Store(tmp_path / "third"), never)


def test_an_object_under_a_wrong_name_is_refused(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bucket = disk_bucket(tmp_path)
    made(bucket, Store(tmp_path / "here"))
    other = f"{8:032x}"
    os.rename(tmp_path / "bucket" / OBJECT, tmp_path / "bucket" / f"fit/{other}.tar")
    store = Store(tmp_path / "there")
    found = get_or_compute(bucket, store, "fit", other, lambda: store.get_or_compute("fit", other, lambda out: {}))
    assert found.files == {} and "holds something else" in caplog.text


def test_an_object_that_would_fill_the_disk_is_not_fetched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bucket = disk_bucket(tmp_path)
    made(bucket, Store(tmp_path / "here"))
    monkeypatch.setattr(packed, "SPARE_BYTES", 1 << 60)
    with pytest.raises(InputError, match="make room"):
        made(bucket, Store(tmp_path / "there"))


def test_an_object_that_would_fill_the_disk_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The object holds one copy of a file that is unpacked fifty times."""

    def many(out: Path) -> dict[str, float]:
        for number in range(50):
            (out / str(number)).write_bytes(bytes(10_000))
        return {}

    bucket = disk_bucket(tmp_path)
    made(bucket, Store(tmp_path / "here"), many)
    free = packed.SPARE_BYTES + 100_000
    assert (tmp_path / "bucket" / OBJECT).stat().st_size < 100_000
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    with pytest.raises(InputError, match="make room"):
        made(bucket, Store(tmp_path / "there"), never)


def test_failed_work_can_be_done_by_another_machine(bucket: Bucket, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError):
        made(bucket, Store(tmp_path / "here"), Mock(side_effect=RuntimeError("crash")))
    made(bucket, Store(tmp_path / "there"))
    assert bucket.read_note(f"fit/{KEY}.lease.0") is bucket.read_note(f"fit/{KEY}.lease.1") is None


def test_a_result_whose_upload_failed_is_shared_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bucket, store = disk_bucket(tmp_path), Store(tmp_path / "here")
    with monkeypatch.context() as patch:
        patch.setattr(type(bucket.fs), "put_file", lambda *_: (_ for _ in ()).throw(TimeoutError("too slow")))
        with pytest.raises(BucketError, match=r"file://.*tar: too slow; can the bucket be reached\?$"):
            made(bucket, store)
    made(bucket, store, never)
    made(bucket, Store(tmp_path / "there"), never)


def resumed(bucket: Bucket, store: Store, work: Callable[[Path], dict[str, float]]) -> Artifact:
    """Get or compute the artifact of a training, which resumes from the file `checkpoint`."""

    def compute() -> Artifact:
        return store.get_or_compute("training", KEY, work, resumable=True)

    return get_or_compute(bucket, store, "training", KEY, compute, "checkpoint")


def finish(out: Path) -> dict[str, float]:
    (out / "checkpoint").unlink()
    return write(out)


def wait_until(reached: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + 20
    while not reached():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


def test_another_machine_resumes_failed_work_from_its_checkpoint(bucket: Bucket, tmp_path: Path) -> None:
    def fail(out: Path) -> dict[str, float]:
        (out / "checkpoint").write_text("step 100")
        raise RuntimeError("crash")

    def go_on(out: Path) -> dict[str, float]:
        assert [path.name for path in out.iterdir()] == ["checkpoint"]
        assert (out / "checkpoint").read_text() == "step 100"
        return finish(out)

    here, there = Store(tmp_path / "here"), Store(tmp_path / "there")
    with pytest.raises(RuntimeError):
        resumed(bucket, here, fail)
    assert bucket.read_note(CHECKPOINT) == b"step 100"
    assert resumed(bucket, there, go_on).files.keys() == {"again", "deep/letters"}
    assert bucket.read_note(CHECKPOINT) is None and clean(there)
    resumed(bucket, here, never)
    for store in (here, there):
        assert {path.name for path in (store.root / "training").iterdir()} == {KEY, f"{KEY}.json", f"{KEY}.lock"}


def test_work_resumes_from_the_checkpoint_of_the_machine_that_worked_last(bucket: Bucket, tmp_path: Path) -> None:
    """A newer local checkpoint, which did not reach the bucket, is kept and uploaded; another machine's replaces it."""
    begun = []

    def fail(out: Path) -> dict[str, float]:
        begun.append((out / "checkpoint").read_text() if (out / "checkpoint").exists() else "")
        if not begun[-1]:
            (out / "checkpoint").write_text("step 100")
        raise RuntimeError("crash")

    def attempt(store: Store) -> None:
        with pytest.raises(RuntimeError):
            resumed(bucket, store, fail)

    here, there = Store(tmp_path / "here"), Store(tmp_path / "there")
    own = here.path("training", KEY, ".partial") / "checkpoint"
    attempt(here)
    own.write_text("step 900")
    attempt(here)
    assert begun == ["", "step 900"] and bucket.read_note(CHECKPOINT) == b"step 900"
    attempt(there)
    bucket.upload(write_file(tmp_path / "elsewhere", "step 2000"), CHECKPOINT)
    attempt(here)
    assert begun[2:] == ["step 900", "step 2000"] and own.read_text() == "step 2000"
    bucket.remove(CHECKPOINT)
    attempt(here)
    assert bucket.read_note(CHECKPOINT) == b"step 2000"


def test_a_checkpoint_may_be_removed_while_it_is_fetched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bucket, store = disk_bucket(tmp_path), Store(tmp_path / "here")
    monkeypatch.setattr(Bucket, "size_bytes", lambda self, name: 8 if name == CHECKPOINT else None)
    resumed(bucket, store, write)
    assert clean(store)


def test_each_new_checkpoint_is_uploaded_once_during_the_work(
    bucket: Bucket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uploads, upload = [], Bucket.upload

    def counted(self: Bucket, path: Path, name: str) -> None:
        uploads.append(name)
        upload(self, path, name)

    def work(out: Path) -> dict[str, float]:
        for text in ("step 100", "step 200"):
            (out / "beside").write_text(text)
            os.replace(out / "beside", out / "checkpoint")
            wait_until(lambda text=text: bucket.read_note(CHECKPOINT) == text.encode())
            time.sleep(0.05)
        return finish(out)

    monkeypatch.setattr(shared_checkpoint, "LOOK_S", 0.01)
    monkeypatch.setattr(Bucket, "upload", counted)
    resumed(bucket, Store(tmp_path / "here"), work)
    assert bucket.read_note(CHECKPOINT) is None and uploads == [CHECKPOINT, CHECKPOINT, f"training/{KEY}.tar"]


def test_a_checkpoint_replaced_during_its_upload_arrives_intact(
    bucket: Bucket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint, upload = tmp_path / "checkpoint", Bucket.upload
    checkpoint.write_text("old and long")

    def replaced(self: Bucket, path: Path, name: str) -> None:
        (tmp_path / "beside").write_text("new")
        os.replace(tmp_path / "beside", checkpoint)
        upload(self, path, name)

    monkeypatch.setattr(Bucket, "upload", replaced)
    shared_checkpoint._put(bucket, CHECKPOINT, checkpoint, tmp_path / "known")
    assert bucket.read_note(CHECKPOINT) == b"old and long" and checkpoint.read_text() == "new"


def test_refused_work_leaves_no_checkpoint(tmp_path: Path) -> None:
    bucket, store = disk_bucket(tmp_path), Store(tmp_path / "here")
    bucket.upload(write_file(tmp_path / "elsewhere", "step 100"), CHECKPOINT)

    with pytest.raises(InputError, match="nobody"):
        resumed(bucket, store, Mock(side_effect=InputError("nobody is in the pictures")))
    assert bucket.read_note(CHECKPOINT) is None and not store.path("training", KEY, ".partial").exists()


def test_work_continues_if_the_checkpoint_cannot_be_uploaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(shared_checkpoint, "LOOK_S", 0.01)
    bucket, upload = disk_bucket(tmp_path), Bucket.upload

    def slow(self: Bucket, path: Path, name: str) -> None:
        if name == CHECKPOINT:
            raise BucketError("too slow")
        upload(self, path, name)

    def work(out: Path) -> dict[str, float]:
        (out / "checkpoint").write_text("step 100")
        wait_until(lambda: "too slow" in caplog.text)
        return finish(out)

    monkeypatch.setattr(Bucket, "upload", slow)
    resumed(bucket, Store(tmp_path / "here"), work)
    resumed(bucket, Store(tmp_path / "there"), never)


def test_checkpoints_are_shared_again_once_the_local_disk_has_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full, store = [OSError(errno.ENOSPC, "No space left on device")], Store(tmp_path / "here")

    def note(path: Path, text: str) -> None:
        if full:
            raise full.pop()
        replace_text(path, text)

    def work(out: Path) -> dict[str, float]:
        (out / "checkpoint").write_text("step 100")
        wait_until(store.path("training", KEY, ".shared").exists)
        return finish(out)

    monkeypatch.setattr(shared_checkpoint, "LOOK_S", 0.01)
    monkeypatch.setattr(shared_checkpoint, "replace_text", note)
    resumed(disk_bucket(tmp_path), store, work)


def test_a_fetched_checkpoint_is_not_written_through_links(tmp_path: Path) -> None:
    bucket, store = disk_bucket(tmp_path), Store(tmp_path / "here")
    bucket.upload(write_file(tmp_path / "elsewhere", "step 100"), CHECKPOINT)
    outside = tmp_path / "outside"
    outside.mkdir()
    partial = store.path("training", KEY, ".partial")
    partial.parent.mkdir(parents=True)
    partial.symlink_to(outside)
    resumed(bucket, store, finish)
    assert list(outside.iterdir()) == []
    key = store.path("training", KEY)
    for made in (key, key.with_name(f"{KEY}.json")):
        shutil.rmtree(made) if made.is_dir() else made.unlink()
    bucket.remove(f"training/{KEY}.tar")
    bucket.upload(tmp_path / "elsewhere", CHECKPOINT)
    partial.mkdir()
    (partial / "checkpoint.tmp").symlink_to(outside / "planted")
    resumed(bucket, store, finish)
    assert list(outside.iterdir()) == []


def write_file(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def work_in(root: Path, store: str, expiry_s: float) -> None:
    """Compute the artifact slowly, and add a line to `<root>/done`; runs in a process of its own."""

    def slowly(out: Path) -> dict[str, float]:
        time.sleep(0.3)
        with (root / "done").open("a") as done:
            done.write(f"{store}\n")
        return write(out)

    lease.BEAT_S, lease.EXPIRY_S, lease.LOOK_S = 0.1, expiry_s, 0.05
    made(disk_bucket(root), Store(root / store), slowly)


def test_two_workers_with_separate_stores_compute_an_artifact_once(tmp_path: Path) -> None:
    workers = [SPAWN.Process(target=work_in, args=(tmp_path, name, 5.0)) for name in ("here", "there")]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert [worker.exitcode for worker in workers] == [0, 0]
    assert len((tmp_path / "done").read_text().split()) == 1
    assert clean(Store(tmp_path / "here")) and clean(Store(tmp_path / "there"))
    assert [path.name for path in (tmp_path / "bucket" / "fit").iterdir()] == [Path(OBJECT).name]


def test_a_worker_killed_at_a_random_moment_loses_nothing(tmp_path: Path) -> None:
    victim = SPAWN.Process(target=work_in, args=(tmp_path, "here", 0.6))
    victim.start()
    deadline_s = time.monotonic() + 60
    while not (tmp_path / "bucket" / "fit").exists() and time.monotonic() < deadline_s:
        time.sleep(0.01)
    time.sleep(random.uniform(0, 0.4))
    os.kill(victim.pid, signal.SIGKILL)
    victim.join()
    rescuer = SPAWN.Process(target=work_in, args=(tmp_path, "there", 0.6))
    rescuer.start()
    rescuer.join()
    assert rescuer.exitcode == 0
    made(disk_bucket(tmp_path), Store(tmp_path / "third"), never)
    assert clean(Store(tmp_path / "there"))

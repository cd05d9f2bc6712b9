import errno
import fcntl
import multiprocessing
import os
import re
import shutil
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.synchronize import Event
from pathlib import Path
from unittest.mock import Mock

import pytest

from tasks import garbage as module
from tasks import pins
from tasks.garbage import collect, find_garbage
from tasks.inventory import Inventory
from tasks.pins import pinned
from tasks.store import Store
from tests.tasks.stores import LONG_AGO_S, add, names, run_of

SPAWN = multiprocessing.get_context("spawn")
PATIENCE_S = 60.0


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Store:
    """Return an empty store, whose artifacts do not count as in use by this process."""
    monkeypatch.setattr("tasks.store.pin", lambda *_: None)
    return Store(tmp_path)


def garbage(store: Store, keep: int = 1, older_s: float = 0.0) -> set[str]:
    return {f"{one.stage}/{one.key}" for one in find_garbage(Inventory.of(store), keep, older_s)}


def test_latest_results_and_their_inputs_stay(store: Store) -> None:
    before, now, other = run_of(store, "ada", 10), run_of(store, "ada", 20), run_of(store, "bob", 30)
    assert garbage(store) == names(before)
    for one in find_garbage(Inventory.of(store), 1, 0):
        assert collect(store, one)
    assert Inventory.of(store).stored.keys() == names(now + other)
    assert sorted(path.name for path in (store.root / "capture").iterdir()) == sorted(
        f"{n:032x}{end}" for n in (20, 30) for end in ("", ".json", ".lock")
    )


def test_more_results_of_each_subject_can_be_kept(store: Store) -> None:
    first, second = run_of(store, "ada", 10), run_of(store, "ada", 20)
    run_of(store, "ada", 30)
    run_of(store, "bob", 40)
    assert garbage(store, keep=2) == names(first) and garbage(store, keep=1) == names(first + second)


def test_an_unfinished_run_does_not_replace_the_finished_one(store: Store) -> None:
    first, second = run_of(store, "ada", 10), run_of(store, "ada", 20)
    store.link_latest("ada", add(store, "fit", 30, second[0]))
    assert Inventory.of(store).latest["ada"].keys() == {"capture", "fit"}
    assert garbage(store) == names(first)


def test_rows_of_an_ablation_do_not_count_as_results(store: Store) -> None:
    """They end with an evaluation, but no subject links to them."""
    first, second = run_of(store, "ada", 10), run_of(store, "ada", 20)
    rows = [add(store, "training", 30 + n, second[2]) for n in range(3)]
    rows += [add(store, "evaluation", 40 + n, row) for n, row in enumerate(rows)]
    assert garbage(store, keep=2) == names(rows) and garbage(store, keep=1) == names(first + rows)


def test_recently_used_artifacts_stay(store: Store) -> None:
    before, _ = run_of(store, "ada", 10), run_of(store, "ada", 20)
    store.find("fit", before[1].root.name)
    assert garbage(store, older_s=3600) == names(before) - {before[1].name}


def test_a_clock_that_was_ahead_keeps_nothing_of_a_removed_person(store: Store) -> None:
    for one in run_of(store, "ada", 10):
        os.utime(one.root.with_name(f"{one.root.name}.json"), times=(2e9 + LONG_AGO_S,) * 2)
    shutil.rmtree(store.subject_folder("ada"))
    everything = {f"{path.parent.name}/{path.stem}" for path in store.root.glob("*/*.json")}
    assert len(everything) == 6 and garbage(store) == everything and garbage(store, older_s=1) == set()


def test_an_artifact_used_between_search_and_removal_stays(store: Store) -> None:
    before, _ = run_of(store, "ada", 10), run_of(store, "ada", 20)
    found = find_garbage(Inventory.of(store), 1, 0)
    used = store.find("fit", before[2].root.name)
    assert used == before[2]
    assert sorted(collect(store, one) for one in found) == [False, *5 * [True]]
    assert store.find("fit", before[2].root.name) == used


def use(root: Path, used: Event, done: Event) -> None:
    Store(root).find("fit", f"{12:032x}")
    used.set()
    done.wait(PATIENCE_S)


def test_artifacts_in_use_stay_until_their_process_is_killed(store: Store) -> None:
    before, _ = run_of(store, "ada", 10), run_of(store, "ada", 20)
    used, done = SPAWN.Event(), SPAWN.Event()
    process = SPAWN.Process(target=use, args=(store.root, used, done))
    process.start()
    assert used.wait(PATIENCE_S)
    assert pinned(store.root) == {before[2].name}
    assert garbage(store) == names(before[3:])  # the fit was computed from the others
    os.kill(process.pid, signal.SIGKILL)
    process.join(PATIENCE_S)
    assert garbage(store) == names(before)
    assert list((store.root / pins.FOLDER).iterdir()) == []


def test_garbage_can_be_listed_in_a_read_only_store(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests may run as root, which may write anywhere, so removal is made to fail."""
    before, _ = run_of(store, "ada", 10), run_of(store, "ada", 20)
    (store.root / pins.FOLDER).mkdir(exist_ok=True)
    (store.root / pins.FOLDER / "0dead").write_text(f"{before[0].name}\n")

    monkeypatch.setattr(os, "unlink", Mock(side_effect=OSError(errno.EROFS, "Read-only file system")))
    assert garbage(store) == names(before)


def test_unfinished_work_is_removed_unless_it_is_locked(store: Store) -> None:
    run_of(store, "ada", 10)
    fit = store.root / "fit"
    for number, end in ((90, ".partial"), (91, ".partial"), (92, "")):
        folder = fit / f"{number:032x}{end}"
        folder.mkdir()
        (folder / "half").write_text("ab")
        for path in (folder / "half", folder):
            os.utime(path, (LONG_AGO_S,) * 2)
    (fit / f"{93:032x}.lock").touch()
    (fit / f"{94:032x}.json.partial").symlink_to(store.root / "subjects")
    (fit / "notes.txt").touch()
    found = find_garbage(Inventory.of(store), 1, 0)
    assert {one.key for one in found} == {f"{n:032x}" for n in (90, 91, 92, 93, 94)}
    with (fit / f"{91:032x}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert garbage(store) == {f"fit/{n:032x}" for n in (90, 92, 93, 94)}
        assert {one.key for one in found if not collect(store, one)} == {f"{91:032x}"}
        lock.flush()
    left = {path.name for path in fit.iterdir()} - {f"{n:032x}{e}" for n in (11, 12) for e in ("", ".json", ".lock")}
    assert left == {f"{91:032x}.partial", f"{91:032x}.lock", "notes.txt"}
    assert (store.root / "subjects" / "ada").is_dir()


def test_work_whose_next_try_is_still_to_come_stays(tmp_path: Path) -> None:
    def fail(out: Path) -> dict[str, float]:
        (out / "checkpoint").touch()
        raise OSError(errno.ESTALE, "Stale file handle")

    store = Store(tmp_path)
    with pytest.raises(OSError, match="Stale"):
        store.get_or_compute("training", "a" * 32, fail, resumable=True)
    assert garbage(store) == set()


def test_unreadable_artifacts_are_removed_unless_a_subject_links_to_them(store: Store) -> None:
    """A damaged record, and a record whose folder was deleted. Otherwise both would stay forever, the first with its
    files."""
    before, now = run_of(store, "ada", 10), run_of(store, "ada", 20)
    for training in (before[3], now[3]):
        record = store.path("training", training.root.name, ".json")
        record.write_text("{")
        os.utime(record, (LONG_AGO_S,) * 2)
    shutil.rmtree(before[2].root)
    for one in find_garbage(Inventory.of(store), 1, 0):
        assert collect(store, one)
    left = {path.name.split(".")[0] for stage in ("fit", "training") for path in (store.root / stage).iterdir()}
    assert left == {one.root.name for one in now[1:4]} and (now[3].root / "deep" / "letters").exists()


@pytest.mark.parametrize("lose", [lambda record: record.write_text("{"), Path.unlink])
def test_an_artifact_that_was_recorded_meanwhile_stays(store: Store, lose: Callable[[Path], object]) -> None:
    """Either a damaged record is written again, or a folder gets its name first and its record later."""
    made = add(store, "fit", 90)
    record = store.path("fit", f"{90:032x}", ".json")
    text = record.read_text()
    lose(record)
    (one,) = find_garbage(Inventory.of(store), 1, 0)
    record.write_text(text)
    os.utime(record, (LONG_AGO_S,) * 2)
    assert not collect(store, one) and store.find("fit", f"{90:032x}") == made


def test_subjects_with_names_like_keys_are_not_garbage(store: Store) -> None:
    run_of(store, "a" * 32, 10)
    assert garbage(store) == set()


def test_work_that_was_resumed_meanwhile_stays(store: Store) -> None:
    partial = store.root / "fit" / f"{90:032x}.partial"
    partial.mkdir(parents=True)
    os.utime(partial, (LONG_AGO_S,) * 2)
    (one,) = find_garbage(Inventory.of(store), 1, 0)
    (partial / "checkpoint").touch()
    assert not collect(store, one) and partial.exists()


def test_a_process_that_waited_for_a_removed_lock_takes_the_new_one(store: Store) -> None:
    """The waiting process locks the file that exists now, so that a third process cannot hold another lock."""
    path = store.path("fit", f"{1:032x}", ".lock")
    held = threading.Event()

    def wait_and_hold() -> None:
        with store.locked("fit", f"{1:032x}"), pytest.raises(BlockingIOError):
            held.set()
            with store.locked("fit", f"{1:032x}", wait=False):
                pass

    with ThreadPoolExecutor() as pool:
        with store.locked("fit", f"{1:032x}"):
            waiting = pool.submit(wait_and_hold)
            awaited = re.compile(rf"-> FLOCK .*:{path.stat().st_ino} ")
            while not awaited.search(Path("/proc/locks").read_text()):
                assert not held.wait(0.01)
            path.unlink()
        waiting.result(PATIENCE_S)


def test_linked_artifacts_with_records_without_inputs_stay(store: Store) -> None:
    made = add(store, "fit", 1)
    record = store.path("fit", made.root.name, ".json")
    record.write_text(record.read_text().replace('"inputs":[]', '"earlier":1').replace('"inputs": []', '"earlier":1'))
    store.link_latest("ada", made)
    assert garbage(store) == set() and module.LEFT.fullmatch("readme") is None

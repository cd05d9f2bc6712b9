import errno
import fcntl
import math
import multiprocessing
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest

from hnerf.errors import InputError, PlaceError
from tasks import pins
from tasks.garbage import collect, find_garbage
from tasks.inventory import Inventory
from tasks.store import RECORDING, Artifact, Store, recording_digest, remove, require_intact

# Not forked: a child would inherit the state of Prefect's threads, but not the threads.
SPAWN = multiprocessing.get_context("spawn")
# SHA-256 of b"abc" (FIPS 180-2, example B.1).
ABC = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def write_abc(out: Path) -> dict[str, float]:
    (out / "deep").mkdir()
    (out / "deep" / "letters").write_text("abc")
    return {"letters": 3.0}


def never(out: Path) -> dict[str, float]:
    raise AssertionError("was to be found in the store")


def test_artifact_is_recorded_with_digests_and_found_again(tmp_path: Path) -> None:
    made = Store(tmp_path).get_or_compute("fit", "k", write_abc)
    found = Store(tmp_path).get_or_compute("fit", "k", never)
    assert found == made
    assert made.root == tmp_path / "fit" / "k"
    assert {name: (file.sha256, file.size_bytes) for name, file in made.files.items()} == {"deep/letters": (ABC, 3)}
    assert made.metrics == {"letters": 3.0}


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_store_on_a_file_system_without_locks_is_refused(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as NFS without lockd: nothing can be made there, and nothing that is there can be pinned."""
    Store(tmp_path / "old").get_or_compute("fit", "k", write_abc)
    monkeypatch.setattr(fcntl, "flock", Mock(side_effect=OSError(number, os.strerror(number))))
    monkeypatch.setattr(pins, "_own", {})
    for name in ("new", "old"):
        with pytest.raises(PlaceError, match=rf"{name}/[.a-z]+: its file system has no locks .*; give --store a fol"):
            Store(tmp_path / name).get_or_compute("fit", "k", never)


def test_digest_depends_only_on_names_and_bytes(tmp_path: Path) -> None:
    first = Store(tmp_path / "a").get_or_compute("fit", "k", write_abc)
    second = Store(tmp_path / "b").get_or_compute("fit", "other", lambda out: write_abc(out) and {})
    renamed = first.model_copy(update={"files": {"deep/lettres": first.files["deep/letters"]}})
    assert first.digest == second.digest
    assert first.digest != renamed.digest


def test_a_metric_that_is_not_finite_is_left_out(tmp_path: Path) -> None:
    metrics = {"nan": math.nan, "endless": math.inf, "one": 1.0}
    made = Store(tmp_path).get_or_compute("segmentation", "k", lambda out: metrics)
    assert made.metrics == {"one": 1.0}
    assert Store(tmp_path).get_or_compute("segmentation", "k", never) == made


@pytest.mark.parametrize("error", [RuntimeError("crash"), KeyboardInterrupt(), InputError("a.jpg: bad")])
def test_half_written_artifact_is_not_seen(tmp_path: Path, error: BaseException) -> None:
    def half(out: Path) -> dict[str, float]:
        write_abc(out)
        raise error

    with pytest.raises(type(error)):
        Store(tmp_path).get_or_compute("fit", "k", half)
    assert Store(tmp_path).find("fit", "k") is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("named", "told"), [(None, "{store}"), ("/elsewhere/a.png", "/elsewhere/a.png")])
def test_a_full_disk_is_told_with_a_path(tmp_path: Path, named: str | None, told: str) -> None:
    def write(out: Path) -> dict[str, float]:
        raise OSError(errno.ENOSPC, "No space left on device", named)

    with pytest.raises(OSError, match=f"No space left on device: '{told.format(store=tmp_path)}'$"):
        Store(tmp_path).get_or_compute("fit", "k", write)


def test_a_vanished_store_does_not_hide_the_original_error(tmp_path: Path) -> None:
    """The original error is raised, so that it can be retried; that the folder is already gone does not hide it."""

    def lose(out: Path) -> dict[str, float]:
        shutil.rmtree(tmp_path / "share")
        raise OSError(errno.ESTALE, "Stale file handle")

    with pytest.raises(OSError, match="Stale file handle"):
        Store(tmp_path / "share").get_or_compute("fit", "k", lose)


def test_concurrent_failures_exclude_each_other_and_leave_no_lock(tmp_path: Path) -> None:
    """Each failure removes the lock that others wait for, and the folder in which they are about to create theirs."""
    alone = threading.Lock()

    def fail(out: Path) -> dict[str, float]:
        assert alone.acquire(blocking=False), "two at once"
        time.sleep(1e-3)
        alone.release()
        raise InputError("a.jpg: bad")

    def attempt(number: int) -> None:
        with pytest.raises(InputError, match=r"a\.jpg: bad"):
            Store(tmp_path / "store").get_or_compute("fit", "k", fail)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(attempt, range(300)))
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_resumable_stage_continues_from_its_partial_folder(tmp_path: Path) -> None:
    def interrupted(out: Path) -> dict[str, float]:
        write_abc(out)
        raise OSError("worker lost")

    with pytest.raises(OSError, match="worker lost"):
        Store(tmp_path).get_or_compute("training", "k", interrupted, resumable=True)
    assert (tmp_path / "training" / "k.partial" / "deep" / "letters").exists()
    artifact = Store(tmp_path).get_or_compute(
        "training", "k", lambda out: {"resumed": (out / "deep").exists()}, resumable=True
    )
    assert artifact.metrics == {"resumed": 1.0}
    assert list(artifact.files) == ["deep/letters"]


@pytest.mark.parametrize("done", [0, 1, 2])
def test_finished_work_that_could_not_be_recorded_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done: int
) -> None:
    """The disk is full, or the process is killed, before one of three renames: of the usage note, of
    the record, or of the folder."""

    def work(out: Path) -> dict[str, float]:
        resumed = (out / "checkpoint.pt").exists()
        for name in ("checkpoint.pt", "checkpoint.pt.tmp", "model"):
            (out / name).write_text("abc")
        return {"resumed": float(resumed)}

    def compute() -> Artifact:
        return Store(tmp_path).get_or_compute("training", "k", work, resumable=True, checkpoint="checkpoint.pt")

    renames = [*done * [Path.rename], Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))]
    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space"):
        patch.setattr(os, "replace", lambda *ends: renames.pop(0)(*ends))
        compute()
    assert renames == []
    made = compute()
    assert made.metrics == {"resumed": 1.0} and list(made.files) == ["model"]
    assert [path.name for path in made.root.iterdir()] == ["model"]


def test_the_checkpoint_left_by_a_killed_commit_is_removed_on_the_next_use(tmp_path: Path) -> None:
    def compute() -> Artifact:
        return Store(tmp_path).get_or_compute("training", "k", write_abc, resumable=True, checkpoint="checkpoint.pt")

    made = compute()
    recorded = sorted(path.name for path in made.root.iterdir())
    (made.root / "checkpoint.pt").write_text("by a process killed before the last step of its commit")
    compute()
    assert sorted(path.name for path in made.root.iterdir()) == recorded


def test_bad_input_leaves_no_partial_folder(tmp_path: Path) -> None:
    def refused(out: Path) -> dict[str, float]:
        write_abc(out)
        raise InputError("a.jpg: bad")

    with pytest.raises(InputError, match=r"a\.jpg: bad"):
        Store(tmp_path).get_or_compute("training", "k", refused, resumable=True)
    assert not (tmp_path / "training" / "k.partial").exists()


def test_a_record_of_another_stage_is_ignored(tmp_path: Path) -> None:
    made = Store(tmp_path).get_or_compute("training", "k", write_abc)
    shutil.copytree(tmp_path / "training", tmp_path / "fit")
    assert Store(tmp_path).find("training", "k") == made and Store(tmp_path).find("fit", "k") is None


NO_RECORDS = ("abd", "[]", "null", "3", '"text"', "[" * 100_000, '{"stage": "fit", "files": []}')


@pytest.mark.parametrize(
    ("victim", "damage"),
    [
        ("k/deep/letters", Path.unlink),
        ("k/deep/letters", lambda path: path.write_text("abd")),
        ("k.json", Path.unlink),
        *(("k.json", partial(Path.write_text, data=text)) for text in NO_RECORDS),
        ("k.json", lambda path: os.truncate(path, 10**13)),  # sparse: it takes no space, and must not be read
    ],
)
def test_a_damaged_or_deleted_artifact_is_computed_again(
    tmp_path: Path, victim: str, damage: Callable[[Path], object]
) -> None:
    made = Store(tmp_path).get_or_compute("fit", "k", write_abc)
    damage(tmp_path / "fit" / victim)
    assert Store(tmp_path).find("fit", "k") is None
    assert Store(tmp_path).get_or_compute("fit", "k", write_abc) == made
    assert Store(tmp_path).find("fit", "k") == made


def test_a_damaged_artifact_that_cannot_be_emptied_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that another process holds open stays as `.nfs...` on NFS. What is left is garbage, and the next damage is
    mended, too."""
    monkeypatch.setattr("tasks.store.pin", lambda *_: None)  # it would count as in use
    store, key = Store(tmp_path), f"{1:032x}"
    store.get_or_compute("fit", key, write_abc)
    with monkeypatch.context() as patch:
        patch.setattr("tasks.store.remove", lambda folder: None)
        for _ in range(2):
            letters = store.path("fit", key) / "deep" / "letters"
            letters.write_text("abd")
            made = store.get_or_compute("fit", key, write_abc, resumable=True)
            assert letters.read_text() == "abc" and store.find("fit", key) == made
    (left,) = [one for one in find_garbage(Inventory.of(store), 1, 0) if one.what == "leftover"]
    assert collect(store, left) and store.find("fit", key) == made
    assert sorted(path.name for path in (tmp_path / "fit").iterdir()) == [key, f"{key}.json", f"{key}.lock"]


def test_links_planted_in_the_store_are_not_followed(tmp_path: Path) -> None:
    victim, fit = tmp_path / "victim", tmp_path / "store" / "fit"
    (victim / "deep").mkdir(parents=True)
    (victim / "letters").write_text("mine")
    fit.mkdir(parents=True)
    for name in ("k.partial", "k", "k.old"):
        (fit / name).symlink_to(victim)
    (fit / "k.json.partial").symlink_to(victim / "letters")
    made = Store(tmp_path / "store").get_or_compute("fit", "k", write_abc, resumable=True)
    assert made.root.is_dir() and not made.root.is_symlink() and list(made.files) == ["deep/letters"]
    assert sorted(p.name for p in victim.rglob("*")) == ["deep", "letters"]
    assert (victim / "letters").read_text() == "mine"


def test_links_in_a_partial_folder_are_removed(tmp_path: Path) -> None:
    (tmp_path / "victim").write_text("mine")
    (tmp_path / "training" / "k.partial").mkdir(parents=True)
    (tmp_path / "training" / "k.partial" / "checkpoint.pt.tmp").symlink_to(tmp_path / "victim")

    def write(out: Path) -> dict[str, float]:
        (out / "checkpoint.pt.tmp").write_text("theirs")
        return {}

    Store(tmp_path).get_or_compute("training", "k", write, resumable=True)
    assert (tmp_path / "victim").read_text() == "mine"


def test_a_link_in_place_of_a_lock_is_refused(tmp_path: Path) -> None:
    (tmp_path / "victim").write_text("mine")
    (tmp_path / "fit").mkdir()
    (tmp_path / "fit" / "k.lock").symlink_to(tmp_path / "victim")
    with pytest.raises(InputError, match=r"k\.lock: is a symbolic link; remove it from the store"):
        Store(tmp_path).get_or_compute("fit", "k", write_abc)
    assert (tmp_path / "victim").read_text() == "mine"


def test_a_complete_store_can_be_read_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests may run as root, which may write anywhere, so every function that writes is made to fail."""
    store = Store(tmp_path)
    made = store.link_latest("ada", store.get_or_compute("fit", "k", write_abc))
    store.claim("ada", "d", tmp_path / "captures" / "ada")

    for name in ("replace", "unlink", "symlink", "rename", "open"):
        monkeypatch.setattr(os, name, Mock(side_effect=OSError(errno.EROFS, "Read-only file system")))
    assert store.get_or_compute("fit", "k", never) == made
    for mounted in ("captures", "elsewhere"):
        store.claim("ada", "d", tmp_path / mounted / "ada")
    assert store.link_latest("ada", made) == made


def test_a_second_recording_of_the_same_name_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store, mine, theirs = Store(tmp_path), tmp_path / "mine" / "ada", tmp_path / "theirs" / "ada"
    store.claim("ada", "d" * 64, mine)
    store.claim("ada", "e" * 64, mine)  # the same folder, changed
    store.claim("ada", "e" * 64, tmp_path / "moved" / "ada")  # the same content, moved
    assert caplog.text == ""
    store.claim("ada", "f" * 64, theirs)
    assert f"subjects/ada showed the results of {tmp_path}/moved/ada and will show those of {theirs}" in caplog.text


def test_a_table_of_another_recording_is_kept(tmp_path: Path) -> None:
    store, table = Store(tmp_path), tmp_path / "ablations" / "ada.b-fast.md"
    mine, theirs = tmp_path / "mine" / "ada", tmp_path / "theirs" / "ada"
    store.claim_table(table, "c" * 64, theirs)  # interrupted before its first row
    store.claim_table(table, "d" * 64, mine)
    table.touch()
    store.claim_table(table, "e" * 64, mine)  # the same folder, changed
    store.claim_table(table, "e" * 64, tmp_path / "moved" / "ada")  # the same content, moved
    with pytest.raises(
        InputError, match=f"ada.b-fast.md: is of {tmp_path}/moved/ada, not of {theirs}; give one of them"
    ):
        store.claim_table(table, "f" * 64, theirs)
    table.with_suffix(".recording").unlink()  # as for a table of an earlier version
    store.claim_table(table, "f" * 64, theirs)


def test_a_damaged_note_of_the_recording_is_written_again(tmp_path: Path) -> None:
    store = Store(tmp_path)
    note = store.subject_folder("ada") / RECORDING
    note.parent.mkdir(parents=True)
    note.write_bytes(b"\xff\xfe")
    store.claim("ada", "d" * 64, tmp_path / "ada")
    assert note.read_text() == f"{'d' * 64}\n{tmp_path / 'ada'}\n"


def test_a_link_in_place_of_an_artifact_is_ignored(tmp_path: Path) -> None:
    """Neither the folder nor the record of an artifact may be a link."""
    made = Store(tmp_path / "elsewhere").get_or_compute("fit", "k", write_abc)
    fit, store = tmp_path / "store" / "fit", Store(tmp_path / "store")
    for linked in ("k", "k.json"):
        shutil.rmtree(fit, ignore_errors=True)
        shutil.copytree(made.root.parent, fit)
        assert store.find("fit", "k") is not None
        remove(fit / linked) if linked == "k" else (fit / linked).unlink()
        (fit / linked).symlink_to(made.root.parent / linked)
        assert store.find("fit", "k") is None


def test_directory_without_record_is_not_an_artifact(tmp_path: Path) -> None:
    """As after a removal that was killed half-way."""
    (tmp_path / "fit" / "k").mkdir(parents=True)
    (tmp_path / "fit" / "k" / "stale").write_text("x")
    assert list(Store(tmp_path).get_or_compute("fit", "k", write_abc).files) == ["deep/letters"]
    assert not (tmp_path / "fit" / "k" / "stale").exists()


def slow_work(root: Path) -> None:
    def write(out: Path) -> dict[str, float]:
        with (root / "calls").open("a") as calls:
            calls.write(f"{os.getpid()}\n")
        time.sleep(0.5)
        return write_abc(out)

    Store(root).get_or_compute("fit", "k", write)


def test_two_concurrent_processes_compute_an_artifact_once(tmp_path: Path) -> None:
    both = [SPAWN.Process(target=slow_work, args=(tmp_path,)) for _ in range(2)]
    for process in both:
        process.start()
    for process in both:
        process.join()
    assert [process.exitcode for process in both] == [0, 0]
    assert len((tmp_path / "calls").read_text().splitlines()) == 1


def hang(root: Path) -> None:
    def write(out: Path) -> dict[str, float]:
        (root / "begun").touch()
        time.sleep(60)
        return {}

    Store(root).get_or_compute("fit", "k", write)


def test_sigkill_leaves_no_lock_and_no_artifact(tmp_path: Path) -> None:
    process = SPAWN.Process(target=hang, args=(tmp_path,))
    process.start()
    while not (tmp_path / "begun").exists():
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert Store(tmp_path).find("fit", "k") is None
    began = time.monotonic()
    Store(tmp_path).get_or_compute("fit", "k", write_abc)
    assert time.monotonic() - began < 5


def test_a_subject_links_to_the_latest_artifact(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for key in ("first", "second"):
        store.link_latest("ada", store.get_or_compute("fit", key, write_abc))
    link = tmp_path / "subjects" / "ada" / "fit"
    assert os.readlink(link) == "../../fit/second"
    assert (link / "deep" / "letters").read_text() == "abc"
    assert list(link.parent.iterdir()) == [link]


def test_new_hands_unlink_results_computed_without_them(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for stage in ("capture", "fit", "asset", "hands"):
        store.link_latest("ada", store.get_or_compute(stage, "k", write_abc))
    assert sorted(path.name for path in (tmp_path / "subjects" / "ada").iterdir()) == ["capture", "hands"]


def test_a_new_artifact_unlinks_results_computed_from_the_old_one(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for stage in ("fit", "training", "asset"):
        store.link_latest("ada", store.get_or_compute(stage, "old", write_abc))
    store.link_latest("ada", store.get_or_compute("training", "old", write_abc))  # the same artifact again
    assert {path.name for path in (tmp_path / "subjects" / "ada").iterdir()} == {"fit", "training", "asset"}
    store.link_latest("ada", store.get_or_compute("fit", "new", write_abc))
    assert [path.name for path in (tmp_path / "subjects" / "ada").iterdir()] == ["fit"]


def test_stages_that_a_run_skipped_are_unlinked_with_later_results(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for stage in ("capture", "hands", "fit"):
        store.link_latest("ada", store.get_or_compute(stage, "k", write_abc))
    store.unlink_latest("ada", {"detection"})
    assert sorted(path.name for path in (tmp_path / "subjects" / "ada").iterdir()) == ["capture", "fit", "hands"]
    store.unlink_latest("ada", {"detection", "hands"})  # from which the fit was computed
    assert sorted(path.name for path in (tmp_path / "subjects" / "ada").iterdir()) == ["capture"]


@pytest.mark.parametrize("name", ["", "..", "../../home", "a/b"])
def test_subject_names_that_lead_out_of_the_store_are_refused(tmp_path: Path, name: str) -> None:
    store = Store(tmp_path)
    artifact = store.get_or_compute("fit", "k", write_abc)
    with pytest.raises(InputError, match=r"capture\.toml: name"):
        store.link_latest(name, artifact)


def test_a_subject_whose_artifact_was_damaged_is_refused(tmp_path: Path) -> None:
    store = Store(tmp_path)
    made = store.link_latest("ada", store.get_or_compute("fit", "k", write_abc))
    require_intact(tmp_path / "subjects" / "ada")
    (made.root / "deep" / "letters").write_text("abd")
    with pytest.raises(InputError, match="fit/k: damaged; repeat the same `hnerf run`"):
        require_intact(tmp_path / "subjects" / "ada")


def test_a_subject_copied_out_of_its_store_is_accepted(tmp_path: Path) -> None:
    (tmp_path / "ada" / "fit").mkdir(parents=True)
    require_intact(tmp_path / "ada")


def test_a_subject_whose_stage_is_on_another_disk_is_found_in_its_store(tmp_path: Path) -> None:
    """Its folder is a link."""
    store, subject = Store(tmp_path / "store"), tmp_path / "store" / "subjects" / "ada"
    (tmp_path / "disk").mkdir()
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "hands").symlink_to(tmp_path / "disk")
    made = store.link_latest("ada", store.get_or_compute("hands", "k", write_abc))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "hands").symlink_to(subject / "hands")
    (tmp_path / "home").symlink_to(subject)
    for folder in (subject, tmp_path / "mine", tmp_path / "home"):
        require_intact(folder)
        assert recording_digest(folder) == made.digest


def test_the_digest_of_the_recording_is_that_of_its_last_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, folder = Store(tmp_path), tmp_path / "subjects" / "ada"
    assert recording_digest(folder) == ""
    for stage in ("capture", "hands"):
        made = store.link_latest("ada", store.get_or_compute(stage, "k", write_abc))
        assert recording_digest(folder) == made.digest
    (tmp_path / "copied" / "capture").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "copied")
    assert recording_digest(Path(".")) == ""

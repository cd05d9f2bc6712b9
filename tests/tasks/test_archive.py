import errno
import io
import json
import os
import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from hnerf.errors import InputError
from tasks import packed as module
from tasks.archive import export_subject, import_subject
from tasks.garbage import collect, find_garbage
from tasks.inventory import Inventory
from tasks.packed import manifest_name
from tasks.store import RECORDING, Store
from tasks.verify import faults
from tests.tasks.stores import add, names, run_of


@pytest.fixture
def packed(tmp_path: Path) -> Path:
    """Return the archive of a subject."""
    store = Store(tmp_path / "from")
    run_of(store, "ada", 10)
    run_of(store, "bob", 20)
    store.claim("ada", "a" * 64, Path("/recordings/ada"))
    export_subject(store, "ada", tmp_path / "ada.tar")
    return tmp_path / "ada.tar"


def test_export_and_import_keep_a_subject_and_all_of_its_inputs(packed: Path, tmp_path: Path) -> None:
    before, store = Store(tmp_path / "from"), Store(tmp_path / "to")
    for _ in range(2):  # the second time, everything is already there
        import_subject(store, packed)
        here, there = Inventory.of(store), Inventory.of(before)
        assert here.latest == {"ada": there.latest["ada"]}
        assert here.stored.keys() == {name for name, owners in there.owners.items() if owners == {"ada"}}
        for name, one in here.stored.items():
            assert one.artifact.digest == there.stored[name].artifact.digest
            assert one.artifact.inputs == there.stored[name].artifact.inputs
        assert store.recording_folder("ada") == "/recordings/ada"
        assert faults(store).lines == []
    assert not list(store.root.glob("*/*.moving"))


def test_the_error_of_a_store_that_cannot_be_archived_is_one_line(tmp_path: Path) -> None:
    """A damaged note of the recording, and a record that lists a file outside of its artifact."""
    store = Store(tmp_path / "from")
    capture, *_ = run_of(store, "ada", 10)
    (store.subject_folder("ada") / RECORDING).write_bytes(b"\xff\0")
    with pytest.raises(InputError, match=r"subjects/ada: recording: [^\n]*; correct it$"):
        export_subject(store, "ada", tmp_path / "ada.tar")
    (tmp_path / "secret").write_text("abc 10")
    record = store.path("capture", capture.root.name, ".json")
    described = json.loads(record.read_text())
    described["files"][str(tmp_path / "secret")] = described["files"]["deep/letters"]
    record.write_text(json.dumps(described))
    with pytest.raises(
        InputError, match=rf"{capture.root}: '{tmp_path}/secret' is not a path inside a folder; correct"
    ):
        export_subject(store, "ada", tmp_path / "ada.tar")


def test_artifacts_that_exist_already_are_kept(packed: Path, tmp_path: Path) -> None:
    store = Store(tmp_path / "to")
    made = run_of(store, "bob", 10)[1]
    import_subject(store, packed)
    assert (made.root / "deep" / "letters").stat().st_nlink == 1
    assert names([made]) <= Inventory.of(store).stored.keys()


def test_a_stage_may_be_on_another_disk(packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its folder is a link, and no file can have a name on both disks."""
    (tmp_path / "big").mkdir()
    (tmp_path / "to").mkdir()
    (tmp_path / "to" / "training").symlink_to(tmp_path / "big")
    monkeypatch.setattr(os, "link", Mock(side_effect=OSError(errno.EXDEV, os.strerror(errno.EXDEV))))
    store = Store(tmp_path / "to")
    import_subject(store, packed)
    assert len(Inventory.of(store).stored) == 6 and faults(store).lines == []


def test_hands_that_the_imported_results_did_not_use_are_not_linked(packed: Path, tmp_path: Path) -> None:
    """Both runs have the same recording, so the link to it stays."""
    store = Store(tmp_path / "to")
    import_subject(store, packed)
    capture = Inventory.of(store).stored[f"capture/{10:032x}"].artifact
    store.link_latest("ada", add(store, "hands", 30, capture))
    import_subject(store, packed)
    assert Inventory.of(store).latest == {"ada": Inventory.of(Store(tmp_path / "from")).latest["ada"]}


def test_a_recording_in_a_bucket_keeps_its_url(tmp_path: Path) -> None:
    before, after = Store(tmp_path / "from"), Store(tmp_path / "to")
    run_of(before, "ada", 10)
    before.claim("ada", "a" * 64, "s3://bucket/ada")
    export_subject(before, "ada", tmp_path / "ada.tar")
    import_subject(after, tmp_path / "ada.tar")
    assert after.recording("ada") == before.recording("ada")


def test_artifacts_are_in_use_during_the_import(packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise a concurrent `gc --older 0` could remove artifacts that were just imported."""

    def placed(store: Store, name: str, *rest: Any) -> None:
        place(store, name, *rest)
        used.append(name in Inventory.of(store).needed())

    used, place = list[bool](), module.place
    monkeypatch.setattr("tasks.archive.place", placed)
    import_subject(Store(tmp_path / "to"), packed)
    assert used == 6 * [True]


def test_a_subject_name_of_another_recording_is_refused(packed: Path, tmp_path: Path) -> None:
    store = Store(tmp_path / "to")
    store.claim("ada", "b" * 64, Path("/recordings/another"))
    with pytest.raises(InputError, match=r"subjects/ada: has the results of another recording"):
        import_subject(store, packed)
    assert list(store.root.iterdir()) == [store.root / "subjects"]


def test_damaged_artifacts_are_not_exported(packed: Path, tmp_path: Path) -> None:
    store = Store(tmp_path / "from")
    next(store.root.glob("fit/*/deep/letters")).write_text("abd")
    with pytest.raises(InputError, match="damaged; repeat"):
        export_subject(store, "ada", tmp_path / "again.tar")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ada.tar", "from"]


@pytest.mark.parametrize("lost", ["training/{:032x}.json", "fit/{:032x}.json", "fit/{:032x}"])
def test_a_subject_that_lacks_a_result_or_an_input_is_not_exported(packed: Path, tmp_path: Path, lost: str) -> None:
    """A linked training and the rough fit, which has no link, without a readable record or without files."""
    store = Store(tmp_path / "from")
    path = store.root / lost.format(13 if lost.startswith("training") else 11)
    path.write_text("{") if path.is_file() else shutil.rmtree(path)
    with pytest.raises(InputError, match=rf"{path.with_suffix('')}: damaged; repeat the same `hnerf run`"):
        export_subject(store, "ada", tmp_path / "again.tar")
    assert not (tmp_path / "again.tar").exists()


def test_inputs_that_were_never_in_this_store_are_left_out(packed: Path, tmp_path: Path) -> None:
    """Another machine computed the training from an equal fit under another key, and shared it through a bucket."""
    store = Store(tmp_path / "from")
    for path in (store.path("fit", f"{11:032x}"), store.path("fit", f"{11:032x}", ".json")):
        path.unlink() if path.is_file() else shutil.rmtree(path)
    assert f"fit/{11:032x}" not in export_subject(store, "ada", tmp_path / "again.tar").artifacts


def repack(path: Path, members: list[tuple[str, bytes]], **changes: Any) -> None:
    with tarfile.open(path, "w", format=tarfile.GNU_FORMAT) as archive:
        for name, content in members:
            member = tarfile.TarInfo(name)
            member.size = len(content)
            for key, value in changes.items():
                setattr(member, key, value)
            archive.addfile(member, io.BytesIO(content))


def unpacked(path: Path) -> list[tuple[str, bytes]]:
    with tarfile.open(path) as archive:
        return [(member.name, archive.extractfile(member).read()) for member in archive]


def change_manifest(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    (_, text), *files = unpacked(path)
    manifest = json.loads(text)
    change(manifest)
    text = json.dumps(manifest).encode()
    repack(path, [(manifest_name(text), text), *files])


def check_refused(packed: Path, why: str | None = None) -> None:
    """Check that an archive is refused and that nothing of it is stored."""
    store = packed.with_name("to")
    with pytest.raises(InputError, match=why):
        import_subject(Store(store), packed)
    assert not store.exists()


NAME = f"fit/{11:032x}"


@pytest.mark.parametrize(
    "path", ["../x", "/x", "a/../../x", "", ".", "a//b", "a/./b", "a\0b", "\ud800", "deep/letters/x", "a" * 2000]
)
def test_paths_out_of_the_artifact_are_refused(packed: Path, path: str) -> None:
    def lead_out(manifest: dict[str, Any]) -> None:
        files = manifest["artifacts"][NAME]["files"]
        files[path] = files["deep/letters"]

    change_manifest(packed, lead_out)
    check_refused(packed, "is not a path inside a folder")


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m.update(subject=".."),
        lambda m: m.update(subject="a/b"),
        lambda m: m.update(subject="\x1b[2J"),
        lambda m: m.update(recording="x\n" * 9),
        lambda m: m.update(more=1),
        lambda m: m["latest"].update(fit="fit/none"),
        lambda m: m["latest"].update({"../x": NAME}),
        lambda m: m["artifacts"].update({"../fit": m["artifacts"][NAME]}),
        lambda m: m["artifacts"][NAME].update(inputs=["../x"]),
        lambda m: m["artifacts"][NAME]["files"]["deep/letters"].update(size_bytes=-1),
        lambda m: m["artifacts"][NAME]["files"]["deep/letters"].update(size_bytes=10**400),
        lambda m: m["artifacts"][NAME]["files"]["deep/letters"].update(sha256="../" * 20),
        lambda m: m["artifacts"][NAME]["files"]["deep/letters"].update(size_bytes=1 << 60),
        lambda m: m["artifacts"][NAME]["files"].update(more={"sha256": "0" * 64, "size_bytes": 1}),
    ],
)
def test_invalid_manifests_are_refused(packed: Path, change: Callable[[dict[str, Any]], None]) -> None:
    change_manifest(packed, change)
    check_refused(packed)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"type": tarfile.SYMTYPE, "linkname": "/etc"}, "not a plain file"),
        ({"type": tarfile.LNKTYPE, "linkname": "x"}, "not a plain file"),
        ({"type": tarfile.FIFOTYPE}, "not a plain file"),
        ({"type": tarfile.XHDTYPE}, "not a plain file"),
        ({"name": "../../x"}, "does not name"),
    ],
)
def test_members_other_than_named_files_are_refused(packed: Path, changes: dict[str, Any], why: str) -> None:
    (manifest, text), *files = unpacked(packed)
    repack(packed, [(manifest, text)])
    whole = packed.read_bytes()[: -(len(packed.read_bytes()) - 512 * (1 + -(-len(text) // 512)))]
    repack(packed, files, **changes)
    packed.write_bytes(whole + packed.read_bytes())
    check_refused(packed, why)


def test_truncated_and_altered_archives_are_refused(packed: Path) -> None:
    whole = packed.read_bytes()
    end = len(whole.rstrip(b"\0"))
    for length in [0, 1, *range(100, end, 331)]:
        packed.write_bytes(whole[:length])
        check_refused(packed)
    packed.write_bytes(whole[: end - 1] + b"?" + whole[end:])
    check_refused(packed, "damaged or cut short")


def test_an_import_that_would_fill_the_disk_is_refused(
    packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SPARE_BYTES", 1 << 60)
    with pytest.raises(InputError, match="make room"):
        import_subject(Store(tmp_path / "to"), packed)


def test_a_file_under_many_paths_counts_once_per_path(
    packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise an archive of 1 GB could name the digest of its file a hundred thousand times."""

    def repeat(manifest: dict[str, Any]) -> None:
        files = manifest["artifacts"][NAME]["files"]
        files |= {f"again/{number}": files["deep/letters"] for number in range(50)}

    free = module.SPARE_BYTES + 50 * len("abc 11")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    import_subject(Store(tmp_path / "once"), packed)
    change_manifest(packed, repeat)
    check_refused(packed, "make room")


def test_leftovers_of_a_killed_import_are_collected(
    packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path / "to")
    run_of(store, "bob", 20)
    monkeypatch.setattr("tasks.archive.unpack", lambda *_: os._exit(9))
    if not (child := os.fork()):
        import_subject(store, packed)
        os._exit(0)
    os.waitpid(child, 0)
    (left,) = find_garbage(Inventory.of(store), keep=1, older_s=0)
    assert collect(store, left) and not list(store.root.glob("*/*.moving"))
    assert not find_garbage(Inventory.of(store), keep=1, older_s=0)

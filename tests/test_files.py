import errno
import os
import time
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from hnerf.errors import InputError
from hnerf.files import atomic_file, atomic_folder, copy_folder, made_folder, now_s, replace_text
from tests.full_disk import files_up_to


def test_an_atomic_folder_gets_its_name_once_it_is_complete(tmp_path: Path) -> None:
    (tmp_path / "ada.partial").mkdir()
    (tmp_path / "ada.partial" / "old").touch()
    with atomic_folder(tmp_path / "ada") as folder:
        (folder / "new").touch()
        assert not (tmp_path / "ada").exists()
    left = ["ada", "ada.partial", "ada.partial/old", "ada/new"]  # an existing folder of that name is not ours
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == left
    assert (tmp_path / "ada").stat().st_mode == (tmp_path / "ada.partial").stat().st_mode


def test_an_atomic_folder_is_removed_after_an_error(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), atomic_folder(tmp_path / "a" / "b" / "ada") as folder:
        (folder / "half").touch()
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_refused_and_not_changed(tmp_path: Path) -> None:
    (tmp_path / "ada").mkdir()
    with pytest.raises(InputError, match="ada: exists; give the name of a new folder"), atomic_folder(tmp_path / "ada"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["ada"]


def test_a_dangling_link_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "out").symlink_to(tmp_path / "nothing")
    with pytest.raises(InputError, match="out: exists"), atomic_folder(tmp_path / "out"):
        raise AssertionError("too late")


def test_copying_ends_at_the_first_file_for_which_there_is_no_room(tmp_path: Path) -> None:
    (tmp_path / "ada" / "images").mkdir(parents=True)
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / "ada" / "images" / name).write_bytes(b"pixels")
    with files_up_to(4), pytest.raises(OSError) as full:
        copy_folder(tmp_path / "ada", tmp_path / "copy")
    assert full.value.errno == errno.EFBIG and Path(full.value.filename2).parent == tmp_path / "copy" / "images"
    copy_folder(tmp_path / "ada", tmp_path / "copy")
    assert {path.read_bytes() for path in (tmp_path / "copy" / "images").iterdir()} == {b"pixels"}


def test_made_folders_are_removed_if_they_stay_empty(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    with made_folder(tmp_path / "there"), made_folder(tmp_path / "a" / "b"), made_folder(tmp_path / "c"):
        (tmp_path / "c" / "new").touch()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c", "there"]


def test_two_processes_with_one_id_can_replace_a_text_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in two containers that share a folder."""

    def replaced(*ends: Path) -> None:
        monkeypatch.setattr(os, "replace", replace)
        replace_text(tmp_path / "note", "theirs")
        replace(*ends)

    replace = os.replace
    monkeypatch.setattr(os, "replace", replaced)
    replace_text(tmp_path / "note", "mine")
    assert [path.name for path in tmp_path.iterdir()] == ["note"] and (tmp_path / "note").read_text() == "mine"


def test_a_text_is_on_the_disk_before_it_gets_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On ext4, a file that has its name alone is empty after a power cut."""
    done: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda file: done.append(Path(f"/dev/fd/{file}").read_text()))
    monkeypatch.setattr(os, "replace", lambda *_: done.append("named"))
    replace_text(tmp_path / "note", "mine")
    assert done == ["mine", "named"]


def test_a_failed_replacement_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "replace", Mock(side_effect=OSError("full")))
    with pytest.raises(OSError, match="full"):
        replace_text(tmp_path / "note", "mine")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("missing", ["folder", "file"])
def test_an_error_names_the_file_and_not_its_temporary_copy(tmp_path: Path, missing: str) -> None:
    path = tmp_path / "no" / "ada.tar" if missing == "folder" else tmp_path / "ada.tar"
    with pytest.raises(FileNotFoundError) as caught, atomic_file(path) as beside:
        if missing == "folder":
            beside.touch()
    assert str(caught.value) == f"[Errno 2] No such file or directory: '{path}'"


def test_the_time_is_that_of_new_files_or_else_this_machines(tmp_path: Path) -> None:
    before_s = now_s(tmp_path)
    (tmp_path / "a").touch()
    assert before_s <= (tmp_path / "a").stat().st_mtime <= now_s(tmp_path) and len(list(tmp_path.iterdir())) == 1
    assert abs(now_s(tmp_path / "missing") - time.time()) < 5


@pytest.mark.parametrize("written", [atomic_file, atomic_folder])
def test_the_error_of_a_full_disk_names_what_was_to_be_written(written: Any, tmp_path: Path) -> None:
    """A failed write names no file."""
    with pytest.raises(OSError, match=f"No space left on device: '{tmp_path}/ada'"), written(tmp_path / "ada"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(OSError, match=r"Input/output error$"), written(tmp_path / "ada"):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

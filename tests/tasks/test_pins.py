import errno
import fcntl
import os
from pathlib import Path
from typing import IO, Any
from unittest.mock import Mock

import pytest

from tasks import pins
from tasks.pins import FOLDER, pin, pinned, unless_read_only


def test_artifacts_used_by_this_process_are_pinned(tmp_path: Path) -> None:
    assert pinned(tmp_path) == set()
    pin(tmp_path, "fit/1")
    pin(tmp_path, "capture/2")
    assert pinned(tmp_path) == {"fit/1", "capture/2"}
    assert len(list((tmp_path / FOLDER).iterdir())) == 1


def test_pins_of_a_dead_process_are_removed(tmp_path: Path) -> None:
    """The kernel has released the lock of the dead process."""
    left = tmp_path / FOLDER / "0123"
    left.parent.mkdir()
    left.write_text("fit/1\n")
    with left.open() as alive:
        fcntl.flock(alive, fcntl.LOCK_EX)
        assert pinned(tmp_path) == {"fit/1"}
    assert pinned(tmp_path) == set() and not left.exists()


def test_in_a_read_only_store_nothing_is_pinned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pins, "_begin", Mock(side_effect=OSError(errno.EROFS, os.strerror(errno.EROFS))))
    pin(tmp_path, "fit/1")
    assert pinned(tmp_path) == set()


@pytest.mark.parametrize(("number", "warnings"), [(errno.EROFS, 0), (errno.EACCES, 1), (errno.EPERM, 1)])
def test_who_may_not_write_into_a_store_that_others_clean_up_is_warned_once(
    number: int, warnings: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(pins, "_begin", Mock(side_effect=OSError(number, os.strerror(number))))
    for name in ("fit/1", "fit/2"):
        pin(tmp_path, name)
    assert caplog.messages == warnings * [
        f"{tmp_path}: not writable for this user: `hnerf store gc` of its owner may remove what is being read"
    ]


def test_a_full_disk_is_not_treated_as_a_read_only_store() -> None:
    with pytest.raises(OSError, match="full"), unless_read_only():
        raise OSError(errno.ENOSPC, "full")


def test_the_error_of_a_full_disk_names_the_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(pins, "_begin", lambda _: Mock(flush=Mock(side_effect=full)))
    with pytest.raises(OSError, match=f"No space left on device: '{tmp_path}'"):
        pin(tmp_path, "fit/1")


def test_pins_work_on_nfs_and_may_be_removed_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """NFS allows an exclusive lock only on a file open for writing. A dangling link stands in for a removed file."""
    lock = fcntl.flock

    def lock_as_on_nfs(file: IO[str], how: int) -> None:
        if not file.writable():
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        lock(file, how)

    monkeypatch.setattr(fcntl, "flock", lock_as_on_nfs)
    (tmp_path / FOLDER).mkdir()
    (tmp_path / FOLDER / "0123").write_text("fit/1\n")
    (tmp_path / FOLDER / "4567").symlink_to("gone")
    assert pinned(tmp_path) == set()


def test_pins_in_a_read_only_store_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without locks, nothing tells which pins belong to running processes."""
    (tmp_path / FOLDER).mkdir()
    (tmp_path / FOLDER / "0123").write_text("fit/1\n")
    plain = Path.open

    def read_only(self: Path, mode: str = "r", *rest: Any, **more: Any) -> Any:
        if "+" in mode:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))
        return plain(self, mode, *rest, **more)

    monkeypatch.setattr(Path, "open", read_only)
    assert pinned(tmp_path) == {"fit/1"}

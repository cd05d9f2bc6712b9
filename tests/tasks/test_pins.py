import errno
import fcntl
import os
from pathlib import Path

import pytest

from tasks import pins
from tasks.pins import FOLDER, pin, pinned, unless_read_only


def test_what_this_process_uses_is_pinned(tmp_path: Path) -> None:
    assert pinned(tmp_path) == set()
    pin(tmp_path, "fit/1")
    pin(tmp_path, "capture/2")
    assert pinned(tmp_path) == {"fit/1", "capture/2"}
    assert len(list((tmp_path / FOLDER).iterdir())) == 1


def test_what_a_dead_process_used_is_forgotten(tmp_path: Path) -> None:
    """The kernel has released its lock."""
    left = tmp_path / FOLDER / "0123"
    left.parent.mkdir()
    left.write_text("fit/1\n")
    with left.open() as alive:
        fcntl.flock(alive, fcntl.LOCK_EX)
        assert pinned(tmp_path) == {"fit/1"}
    assert pinned(tmp_path) == set() and not left.exists()


def test_a_store_that_may_only_be_read_notes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(pins, "_begin", refused)
    pin(tmp_path, "fit/1")
    assert pinned(tmp_path) == set()


def test_a_full_disk_is_no_read_only_store() -> None:
    with pytest.raises(OSError, match="full"), unless_read_only():
        raise OSError(errno.ENOSPC, "full")

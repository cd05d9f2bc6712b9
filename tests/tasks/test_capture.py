"""The stage that ingests a recording."""

from pathlib import Path
from typing import Any

import pytest

from hnerf.config import CaptureSettings
from hnerf.errors import InputError
from tasks import cage
from tasks.cage import run_caged
from tasks.capture import ingest
from tasks.source import read_capture
from tasks.store import Store
from tests.capture.recordings import write_easymocap


def test_a_recording_that_changes_while_it_is_read_is_not_stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise it would be found under the digest of the earlier content."""

    def changing(*arguments: Any, folder: Path) -> None:
        (folder / "new.txt").touch()
        run_caged(*arguments, folder=folder)

    store = Store(tmp_path / "store")
    source, _ = read_capture(write_easymocap(tmp_path / "folder"))
    monkeypatch.setattr(cage, "run_caged", changing)
    with pytest.raises(InputError, match="folder: changed or moved since the command started"):
        ingest(store, source, CaptureSettings())
    assert not store.root.exists()

import io
import sys
from argparse import ArgumentTypeError
from pathlib import Path

import pytest

from flows.cli import main
from flows.store_commands import duration_s
from tasks.store import Store
from tests.tasks.stores import add, run_of


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Store:
    monkeypatch.setattr("tasks.store.pin", lambda *_: None)
    monkeypatch.chdir(tmp_path)
    run_of(Store(tmp_path / "store"), "ada", 10)
    run_of(Store(tmp_path / "store"), "ada", 20)
    return Store(tmp_path / "store")


def test_list_and_show_name_subjects_and_artifacts(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    store.claim("ada", "a" * 64, Path("/recordings/\x1bada"))
    assert main(["store", "list"]) == 0
    _, ada, total = capsys.readouterr().out.splitlines()
    assert ada.split()[:4] == ["ada", "102", "B", "12"] and ada.endswith("/recordings/\\x1bada")
    assert total.startswith("all: 102 B; not needed: 51 B; free")  # "abc 10", five more, and a name of 15 bytes; twice
    assert main(["store", "show", "ada"]) == 0
    lines = capsys.readouterr().out.splitlines()[2:]
    assert [line.split()[-1] for line in lines if "yes" in line] == [
        f"capture/{20:032x}", f"fit/{22:032x}", f"training/{23:032x}", f"asset/{24:032x}", f"evaluation/{24:032x}"
    ]  # fmt: skip
    assert main(["store", "show", "eve"]) == 2


def test_names_outside_the_terminals_encoding_are_escaped(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    run_of(store, "Łukasz", 10)
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(printed := io.BytesIO(), "latin-1"))
    assert main(["store", "list"]) == 0
    assert b"\n\\u0141ukasz" in printed.getvalue()


def test_nothing_is_removed_without_yes(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["store", "gc", "--older", "1d"]) == 0
    assert capsys.readouterr().out.endswith("not needed: 6, 51 B; nothing was removed: give --yes to remove\n")
    assert main(["store", "gc", "--keep", "2", "--yes"]) == 0
    assert main(["store", "gc", "--older", "999999d", "--yes"]) == 0
    assert main(["store", "verify"]) == 0
    assert "checked: 12 artifacts, 14 files, 102 B" in capsys.readouterr().out
    assert main(["store", "gc", "--yes"]) == 0
    assert capsys.readouterr().out.endswith("removed: 6 of 6, 51 B\n")
    assert main(["store", "gc"]) == 0
    assert capsys.readouterr().out == "not needed: nothing\n"
    assert main(["store", "verify"]) == 0


def test_verify_reports_damage_as_an_error(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    next(store.root.glob("fit/*/deep/letters")).unlink()
    assert main(["store", "verify", "ada"]) == 2
    assert capsys.readouterr().err.startswith("hnerf: store: faults: 1; ")


def test_export_and_import(store: Store, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["store", "export", "ada"]) == 0
    assert main(["store", "export", "ada"]) == 2  # nothing is overwritten
    assert main(["store", "import", "ada.tar", "--store", "other"]) == 0
    assert main(["store", "verify", "--store", "other"]) == 0
    assert main(["store", "import", "none.tar"]) == 2
    assert main(["store", "list", "--store", "none"]) == 2
    assert main(["store", "export", "ada", "--out", "new/ada.tar"]) == 0 and Path("new/ada.tar").exists()
    assert main(["store", "export", "nobody", "--out", "newer/ada.tar"]) == 2 and not Path("newer").exists()


@pytest.mark.parametrize("command", ["list", "verify", "gc --yes --older 0", "show ada", "export ada"])
def test_a_folder_that_is_not_a_store_is_refused(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    thumbnail = tmp_path / "pictures" / "thumbnails" / ("a" * 32)  # named like an artifact
    thumbnail.mkdir(parents=True)
    assert main(["store", *command.split(), "--store", "pictures"]) == 2
    assert capsys.readouterr().err == "hnerf: pictures: not a store; give its folder with --store\n"
    assert thumbnail.is_dir() and not (tmp_path / "ada.tar").exists()


def test_a_copy_that_was_fetched_makes_a_store(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A run that was killed while it fetched a capture from a bucket leaves nothing else."""
    (tmp_path / "fetched" / f"{'a' * 32}.partial").mkdir(parents=True)
    assert main(["store", "list", "--store", str(tmp_path)]) == 0
    assert "all: 0 B" in capsys.readouterr().out


def test_what_a_run_left_that_ended_before_ingestion_is_listed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    add(Store(tmp_path), "cameras", 10)
    assert main(["store", "list", "--store", str(tmp_path)]) == 0
    assert "all: 6 B; not needed: 0 B" in capsys.readouterr().out  # this process uses it


def test_durations() -> None:
    assert [duration_s(text) for text in ("30d", "12h", "5m", "7s", "0")] == [2592000, 43200, 300, 7, 0]
    for text in ("30", "d", "-1d", "1w", "1.5d", ""):
        with pytest.raises(ArgumentTypeError):
            duration_s(text)

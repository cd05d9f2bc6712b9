import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tasks.inventory import Inventory
from tasks.store import Store
from tests.tasks.stores import LONG_AGO_S, add, names, run_of


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Store:
    """Return an empty store, whose artifacts do not count as in use by this process."""
    monkeypatch.setattr("tasks.store.pin", lambda *_: None)
    return Store(tmp_path)


def test_the_inventory_has_sizes_and_times(store: Store) -> None:
    made = add(store, "fit", 7)
    stored = Inventory.of(store).stored[made.name]
    assert (stored.size_bytes, stored.made_s, stored.used_s) == (5, LONG_AGO_S + 7, LONG_AGO_S + 7)  # "abc 7"


def test_inputs_of_inputs_are_included_once(store: Store) -> None:
    capture, rough, fit, training, evaluation, _ = run_of(store, "ada", 10)
    found = Inventory.of(store)
    assert found.with_inputs([evaluation.name]) == names([capture, rough, fit, training, evaluation])
    assert found.with_inputs([rough.name, "fit/gone"]) == names([capture, rough])


def test_an_artifact_without_a_link_belongs_to_the_subject_of_its_recording(store: Store) -> None:
    """For example a degraded fit of ada; bob's results are not affected."""
    capture, *_ = run_of(store, "ada", 10)
    run_of(store, "bob", 20)
    degraded = add(store, "study-fit", 30, capture)
    found = Inventory.of(store)
    assert found.owners[degraded.name] == {"ada"}
    assert [one.artifact.name for one in found.of_subject("ada")][-1] == degraded.name  # the newest one is last
    assert degraded.name not in found.needed()


@pytest.mark.parametrize(
    "change",
    [
        None,
        {"files": {"deep/letters": {"sha256": "0" * 64, "size_bytes": 10**400}}},
        {"files": {"deep/letters": {"sha256": "0" * 64, "size_bytes": -1}}},
        {"files": {"deep/letters": {"sha256": "../" * 20, "size_bytes": 3}}},
        {"inputs": ["../../x"]},
        {"metrics": {"psnr": float("nan")}},
    ],
)
def test_damaged_and_invalid_records_are_listed_as_unreadable(store: Store, change: dict[str, object] | None) -> None:
    record = store.path("fit", add(store, "fit", 7).root.name, ".json")
    record.write_text(json.dumps(json.loads(record.read_text()) | change) if change else "[")
    found = Inventory.of(store)
    assert (found.stored, found.unreadable) == ({}, (record,))


@pytest.mark.parametrize("suffix", [".json", ""])
def test_a_link_in_place_of_an_artifact_is_unreadable(store: Store, suffix: str, tmp_path: Path) -> None:
    key = add(store, "fit", 7).root.name
    store.path("fit", key, suffix).rename(tmp_path / "elsewhere")
    store.path("fit", key, suffix).symlink_to(tmp_path / "elsewhere")
    found = Inventory.of(store)
    assert (found.stored, found.unreadable) == ({}, (store.path("fit", key, ".json"),))


@pytest.mark.parametrize("replace", [os.mkfifo, lambda path: path.symlink_to("named.json")])
def test_the_name_of_a_recording_is_read_only_from_a_regular_file(
    store: Store, replace: Callable[[Path], None]
) -> None:
    """Reading a pipe would wait forever, and a link may lead to a device."""
    capture = add(store, "capture", 7, name="ada")
    assert Inventory.of(store).owners[capture.name] == {"ada"}
    (capture.root / "capture.json").rename(capture.root / "named.json")
    replace(capture.root / "capture.json")
    assert Inventory.of(store).owners[capture.name] == set()

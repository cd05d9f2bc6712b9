from pathlib import Path

import pytest

from hnerf.errors import InputError
from tasks.store import Store
from tasks.verify import faults
from tests.tasks.stores import run_of


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """Return a store with a run of ada and a run of bob."""
    store = Store(tmp_path)
    run_of(store, "ada", 10)
    run_of(store, "bob", 20)
    return store


def test_an_intact_store_has_no_faults(store: Store) -> None:
    everything, of_ada = faults(store), faults(store, ["ada"])
    assert everything.lines == of_ada.lines == []
    assert (everything.artifacts, of_ada.artifacts) == (12, 6)
    assert everything.files == 12 + 2  # letters in each artifact, and a capture.json per person
    assert of_ada.size_bytes == 6 * len("abc 10") + len('{"name": "ada"}')


def test_damaged_missing_and_foreign_files_are_reported(store: Store) -> None:
    letters = sorted(store.root.glob("fit/*/deep/letters"))
    letters[0].write_text("abd")
    (letters[1].parent / "more").touch()
    (store.subject_folder("bob") / "hands").symlink_to(f"../../hands/{99:032x}")
    for number in (97, 98):
        store.path("fit", f"{number:032x}", ".json").write_text("[]")
    store.path("fit", f"{97:032x}").mkdir()
    found = faults(store)
    assert [line.rpartition(": ")[2] for line in found.lines] == [
        "the record cannot be read", "its folder is missing", "leads nowhere", "damaged or missing",
        "not of this artifact",
    ]  # fmt: skip


def test_an_unknown_subject_is_refused(store: Store) -> None:
    with pytest.raises(InputError, match="no such subject"):
        faults(store, ["eve"])

import os
from pathlib import Path
from unittest.mock import Mock

import pytest

from hnerf.files import now_s
from tasks.ledger import STALE_S, Ledger, forget, release, started_from

DIGEST, OTHER = "a" * 64, "b" * 64


def test_a_forgotten_capture_can_be_started_again_under_another_key(tmp_path: Path) -> None:
    ledger = Ledger.of(tmp_path)
    for digest, name in ((DIGEST, "ada"), (OTHER, "bob")):
        ledger.note_started(digest, tmp_path / name, f"run of {name}")
        ledger.note_seen(f"seen-{name}", digest)
    first = ledger.start_key(DIGEST)
    forget(tmp_path, tmp_path / "ada")
    assert not ledger.knows(DIGEST) and not ledger.seen("seen-ada")
    assert ledger.knows(OTHER) and ledger.seen("seen-bob")
    second = ledger.start_key(DIGEST)
    assert second == f"{first} run of ada" == ledger.start_key(DIGEST)
    ledger.note_started(DIGEST, tmp_path / "eve", "second run")
    assert ledger.seen("seen-ada") and ledger.start_key(DIGEST) == first


def test_a_capture_is_released_three_times_and_then_kept(tmp_path: Path) -> None:
    ledger = Ledger.of(tmp_path)
    for digest, name in ((DIGEST, "ada"), (OTHER, "bob")):
        ledger.note_started(digest, tmp_path / name, "a run")
    for known in (False, False, False, True):
        ledger.note_started(DIGEST, tmp_path / "ada", "a run")
        release(tmp_path, tmp_path / "ada", "another run")  # such as an earlier one that is repeated by hand
        assert ledger.knows(DIGEST)
        release(tmp_path, tmp_path / "ada", "a run")
        assert ledger.knows(DIGEST) == known and ledger.knows(OTHER)


def test_a_capture_is_released_even_if_its_disk_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ledger = Ledger.of(tmp_path)
    ledger.note_started(DIGEST, tmp_path / "ada", "a run")
    monkeypatch.setattr("tasks.ledger.replace_text", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space"):
        release(tmp_path, tmp_path / "ada", "a run")
    assert not ledger.knows(DIGEST)


def test_a_store_without_a_ledger_has_nothing_to_forget(tmp_path: Path) -> None:
    forget(tmp_path, tmp_path / "ada")
    assert list(tmp_path.iterdir()) == []


def test_the_age_of_a_listing_counts_from_its_first_query(tmp_path: Path) -> None:
    """First seen 100 s ago. Asking again does not restart the count; starting the capture does."""
    ledger, began_s = Ledger.of(tmp_path), now_s(tmp_path) - 100
    assert ledger.stood_s("seen-ada") < 50
    os.utime(tmp_path / "ingested" / "new-seen-ada", (began_s, began_s))
    assert 100 <= ledger.stood_s("seen-ada") < 150 and 100 <= ledger.stood_s("seen-ada") < 150
    ledger.note_seen("seen-ada", DIGEST)
    assert ledger.stood_s("seen-ada") < 50


def test_notes_about_listings_that_have_changed_since_are_removed(tmp_path: Path) -> None:
    """A growing upload has another listing at every look."""
    ledger, old_s = Ledger.of(tmp_path), now_s(tmp_path) - STALE_S - 1
    for listing in ("seen-old", "seen-new"):
        ledger.stood_s(listing)
        ledger.note_refused(listing, "0.jpg: cannot be read")
        ledger.note_seen(f"{listing}er", DIGEST)
    for path in ledger.root.glob("*-old*"):
        os.utime(path, (old_s, old_s))
    ledger.sweep()
    left = {"new-seen-new", "refused-seen-new", "seen-older", "seen-newer"}
    assert {path.name for path in ledger.root.iterdir()} == left


def test_a_note_that_another_scan_removes_meanwhile_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ledger = Ledger.of(tmp_path)
    for name in ("new-ada", "refused-ada", "new-bob"):
        (ledger.root / name).write_text("")
        os.utime(ledger.root / name, (0, 0))
    unlink = Path.unlink

    def after_another(path: Path) -> None:
        if path.name == "new-ada":
            unlink(ledger.root / "refused-ada")
        unlink(path)

    monkeypatch.setattr(Path, "unlink", after_another)
    ledger.sweep()
    assert not list(ledger.root.iterdir())


@pytest.mark.usefixtures("wrong_clock")
def test_the_age_of_a_listing_does_not_depend_on_this_machines_clock(tmp_path: Path) -> None:
    """The ledger may be on a share, whose server dates the files."""
    assert 0 <= Ledger.of(tmp_path).stood_s("seen-ada") < 50


def test_an_empty_note_is_ignored(tmp_path: Path) -> None:
    ledger = Ledger.of(tmp_path)
    ledger.note_seen("seen-ada", "")
    assert not ledger.seen("seen-ada")


def test_damaged_notes_are_ignored(tmp_path: Path) -> None:
    ledger = Ledger.of(tmp_path)
    for name in (DIGEST, "seen-ada"):
        (ledger.root / name).write_bytes(b"\xff\xfe")
    assert not ledger.seen("seen-ada") and not started_from(tmp_path, tmp_path / "ada")
    forget(tmp_path, tmp_path / "ada")
    assert ledger.knows(DIGEST)

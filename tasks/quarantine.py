"""Notes on why captures of a watched folder gave no result: <folder>/.refused/<name>.txt. The captures stay in
place."""

import hashlib
import os
import time
from contextlib import suppress
from pathlib import Path

from hnerf.errors import printable
from hnerf.files import replace_text
from tasks.ledger import RELEASES, started_from

FOLDER = ".refused"
REMEDY = (
    "Correct the folder: a capture that has changed is tried again by itself. This note goes when a run succeeds, or "
    "with the folder."
)
REPEAT = "If the folder is not to blame, repeat its flow run: prefect flow-run retry ID."
MACHINE = (
    "The folder is probably not to blame: correct the machine. The capture is started again by itself, "
    f"{RELEASES} times in all; after that, repeat its flow run: prefect flow-run retry ID. This note goes when a run "
    "starts or succeeds."
)


def note(capture: Path, why: str, remedy: str = REMEDY) -> None:
    """Write why a capture gave no result, and what to do."""
    path = _path(capture)
    path.parent.mkdir(exist_ok=True)
    text = f"{printable(capture.name)}: {printable(why)}\n\n{remedy}\n"
    if path.is_symlink() or not path.is_file() or path.read_text(errors="replace").partition("\n\nSeen ")[0] != text:
        replace_text(path, f"{text}\n\nSeen {time.strftime('%Y-%m-%d %H:%M:%S %z')}\n")


def note_run(capture: Path | str, store: Path, why: str, remedy: str = f"{REMEDY} {REPEAT}") -> None:
    """Write why a run gave no result, and what to do, if its capture was started from a watched folder (not one in a
    bucket)."""
    if isinstance(capture, Path) and started_from(store, capture):
        with suppress(OSError):  # a folder that is read-only, or gone
            note(capture, why, remedy)


def clear(capture: Path | str) -> None:
    """Remove the note about a capture, if it is in a folder that can be written."""
    if isinstance(capture, Path):
        with suppress(OSError):
            _path(capture).unlink(missing_ok=True)


def clear_removed(folder: Path) -> None:
    """Remove the notes about captures that are no longer in the watched folder; links are not followed."""
    if (folder / FOLDER).is_symlink():
        return
    kept = {_name(name) for name in os.listdir(folder)}
    for path in (folder / FOLDER).glob("*.txt"):
        if path.name not in kept:
            path.unlink(missing_ok=True)


def _path(capture: Path) -> Path:
    """Return the path of the note. Raises OSError if a link there leads elsewhere."""
    path = capture.parent / FOLDER / _name(capture.name)
    if path.parent.is_symlink():
        raise NotADirectoryError(f"{path.parent}: is a symbolic link; remove it")
    return path


def _name(capture: str) -> str:
    """Return the name of a capture's note. If the capture's own is too long to append to, a digest stands for its end:
    a name may have 255 bytes, and a character up to four."""
    if len(os.fsencode(capture)) > 250:
        capture = f"{capture[:50]}-{hashlib.sha256(os.fsencode(capture)).hexdigest()[:8]}"
    return f"{capture}.txt"

"""Folders and texts that come into being whole or not at all; Markdown that carries its pictures."""

import base64
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hnerf.errors import InputError


@contextmanager
def atomic_folder(out: Path) -> Iterator[Path]:
    """An empty folder beside `out` to write into: it takes that name when all is written, and is gone if anything goes
    wrong before. InputError where `out` exists."""
    if out.exists():
        raise InputError(f"{out}: exists; give the name of a new folder")
    missing = [parent for parent in out.parents if not parent.exists()]
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=f"{out.name}.partial-") as beside:
            partial = Path(beside) / out.name  # unlike `beside`, readable by whom the umask says
            partial.mkdir()
            yield partial
            os.replace(partial, out)
    finally:
        for parent in missing:
            with suppress(OSError):  # not empty: all was written
                parent.rmdir()


def replace_text(path: Path, text: str) -> None:
    """Write beside and rename."""
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    beside.write_text(text)
    os.replace(beside, path)


def picture(name: str) -> str:
    """Markdown that shows a file, whose name may hold spaces and parentheses."""
    return f"![{name}](<{name}>)"


def with_pictures(table: Path) -> str:
    """A Markdown file's text, PNG files beside it that `picture` shows as data URIs. OSError where one is missing."""
    return re.sub(r"(?<=\]\()<([^>]+\.png)>", lambda shown: _data_uri(table.with_name(shown[1])), table.read_text())


def _data_uri(path: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"

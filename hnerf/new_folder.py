"""Folders that come into being whole or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hnerf.errors import CaptureError


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """An empty folder beside `out` to write into: it takes that name when all is written, and is gone if anything goes
    wrong before. CaptureError where `out` exists."""
    if out.exists():
        raise CaptureError(f"{out}: exists; give the name of a new folder")
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

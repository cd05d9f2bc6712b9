"""Folders that come into being whole or not at all."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hnerf.errors import CaptureError


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """An empty folder beside `out` to write into: it takes that name when all is written, and is gone if anything goes
    wrong before. CaptureError where `out` exists."""
    if out.exists():
        raise CaptureError(f"{out}: exists; give the name of a new folder")
    partial = out.with_name(f"{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir(parents=True)
        yield partial
        os.replace(partial, out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)

"""Folders and files that are written completely or not at all, and Markdown with embedded images."""

import base64
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from hnerf.errors import DISK_FULL, InputError


@contextmanager
def atomic_folder(out: Path) -> Iterator[Path]:
    """Yield an empty folder to write into; on success it is renamed to `out`, on failure it is deleted.

    It lies next to `out`, in the same file system. Raises InputError if `out` exists.
    """
    require_new(out)
    with made_folder(out.parent), tempfile.TemporaryDirectory(dir=out.parent, prefix=f"{out.name}.partial-") as beside:
        partial = Path(beside) / out.name  # unlike `beside`, it has the permissions of the umask
        partial.mkdir()
        with naming_full_disk(out):
            yield partial
        os.replace(partial, out)


def require_new(out: Path) -> None:
    """Raise InputError if `out` exists."""
    if os.path.lexists(out):
        raise InputError(f"{out}: exists; give the name of a new folder")


@contextmanager
def naming_full_disk(path: Path) -> Iterator[None]:
    """Name `path` in an error about a full disk raised inside that names no file, as failed writes do not."""
    try:
        yield
    except OSError as error:
        if error.errno in DISK_FULL and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Make a folder and its parents if they are missing; at the end, remove those that are still empty."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        for path in missing:
            with suppress(OSError):  # it is not empty
                path.rmdir()


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield the path of a file to write next to `path`; on success it replaces `path`, on failure it is deleted. Errors
    name `path`."""
    beside = path.with_name(f".{uuid4().hex}")
    try:
        with naming_full_disk(path):
            yield beside
        os.replace(beside, path)
    except OSError as error:
        if str(error.filename) != str(beside):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        beside.unlink(missing_ok=True)


def replace_text(path: Path, text: str) -> None:
    """Replace a text file atomically, also if the power fails: on the disk, a file may otherwise have its name before
    its text."""
    encoded = text.encode()
    with atomic_file(path) as beside, beside.open("xb") as file:  # never through a link that lies there
        file.write(encoded)
        file.flush()
        os.fsync(file.fileno())


def now_s(folder: Path) -> float:
    """Return the time, in seconds since 1970, by the clock that dates files in a folder. On a share, that is another
    machine's clock; if the folder cannot be written, it is this machine's."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            return os.fstat(file.fileno()).st_mtime
    except OSError:
        return time.time()


def copy_folder(source: Path, target: Path) -> None:
    """Copy the files of a folder into another one. Unlike `shutil.copytree`, end at the first error: a full disk would
    be reported once for every file."""
    for path in source.rglob("*"):
        if path.is_file():
            copy = target / path.relative_to(source)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)


def markdown_image(name: str) -> str:
    """Return Markdown that shows an image file, whose name may contain spaces and parentheses."""
    return f"![{name}](<{name}>)"


def embed_images(table: Path) -> str:
    """Return the text of a Markdown file with the PNG files that `markdown_image` refers to, which lie next to it,
    embedded as data URIs. Raises OSError if one is missing."""
    return re.sub(r"(?<=\]\()<([^>]+\.png)>", lambda shown: png_data_uri(table.with_name(shown[1])), table.read_text())


def png_data_uri(path: Path) -> str:
    """Return a PNG file as a data URI."""
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"

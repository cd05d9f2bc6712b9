"""A capture folder as the user provides it, and digests of its files."""

import hashlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NoReturn

from pydantic import BaseModel

from hnerf.errors import InputError, raise_if_unreachable
from tasks.store import sha256_of

GROUND_TRUTH = "ground_truth"
MAX_FILE_BYTES = 1 << 38  # a sparse file takes no disk space, but hours to read


class GoneError(InputError):
    """There is no capture at a path or URL, or no longer."""


def path_or_url(given: Path | str) -> Path | str:
    """Return a path, or the URL of something in a bucket. file:// URLs become paths. Raises InputError for an empty
    text, which as a path would be the current folder."""
    text = str(given).removeprefix("file://")
    if not text:
        raise InputError("the capture's folder is empty text; give its path or URL")
    return text if isinstance(given, str) and "://" in text else Path(text)


class Source(BaseModel):
    """Part of the capture folder `root`: the recording, or its ground truth. name: the folder's; digest: SHA-256 of the
    part's file names and bytes, independent of where the folder is."""

    root: Path
    name: str
    digest: str
    is_truth: bool = False


def read_capture(folder: Path, store: Path | None = None) -> tuple[Source, Source]:
    """Return the recording and its ground truth: the files outside `ground_truth/`, and those inside. A recording may
    also be a single video, which has no ground truth.

    Hidden files do not count. A symbolic link counts as the path that it holds: its target is either in the folder
    itself or not part of it. Raises GoneError if there is no such folder, and InputError if a file cannot be
    read, or the store is inside the capture, whose digest would then change with every run.
    """
    folder = folder.resolve()
    if not folder.exists():
        raise GoneError(f"{folder}: no such folder or video; give the capture's folder")
    if store and store.resolve().is_relative_to(folder):
        raise InputError(f"{store.resolve()}: lies in the capture's folder; give --store another folder")
    shown = os.fsencode(folder).decode(errors="replace")
    if shown != str(folder):
        raise InputError(f"{shown}: the folder's name is not UTF-8; rename it")
    if "\n" in shown:
        raise InputError(f"{shown}: the folder's name has a line break; rename it")
    recording, truth = _parts(folder)
    return (
        Source(root=folder, name=folder.name, digest=_digest(folder, recording)),
        Source(root=folder, name=folder.name, digest=_digest(folder, truth), is_truth=True),
    )


def require_unchanged(source: Source) -> None:
    """Raise InputError if the files of a recording or a ground truth no longer match its digest: results from other
    files must not be found under that key later. It is a GoneError if the whole folder is gone."""
    kind = InputError if source.root.exists() else GoneError
    files = [] if kind is GoneError else _parts(source.root)[source.is_truth]
    if _digest(source.root, files) != source.digest:
        folder = source.root / GROUND_TRUTH if source.is_truth else source.root
        raise kind(f"{folder}: changed or moved since the command started; run the same command again")


def capture_files(folder: Path) -> list[Path]:
    """Return the files and symbolic links in a capture folder, sorted, without hidden ones and devices; for a single
    video, the video. Raises InputError if a folder cannot be read."""
    if folder.is_file():
        return [folder]
    return sorted(Path(entry.path) for entry in entries(folder))


def entries(folder: Path | str, hidden: bool = False) -> Iterator["os.DirEntry[str]"]:
    """Yield the directory entries of these files, in no particular order. An entry knows whether it is a link without
    another system call. hidden: include hidden ones."""
    waiting = [os.fspath(folder)]
    while waiting:
        try:
            with os.scandir(waiting.pop()) as found:
                shown = [entry for entry in found if hidden or not entry.name.startswith(".")]
                waiting += [entry.path for entry in shown if entry.is_dir(follow_symlinks=False)]
        except OSError as error:
            _refuse(error)
        yield from (entry for entry in shown if entry.is_symlink() or entry.is_file(follow_symlinks=False))


def _parts(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the files of the recording in a capture folder, and the files of its ground truth. Raises InputError if
    one cannot be used: to read those before it may take hours."""
    files, truth = capture_files(folder), folder / GROUND_TRUTH
    for path in files:
        _require_usable(path, folder)
    return [f for f in files if not f.is_relative_to(truth)], [f for f in files if f.is_relative_to(truth)]


def _require_usable(path: Path, folder: Path) -> None:
    """Raise InputError if a file cannot be opened, is too large or has a line break in its name or in what it links to,
    with which two folders could have the same digest."""
    name = str(path.relative_to(folder.parent))
    try:
        if path.lstat().st_size > MAX_FILE_BYTES:
            raise InputError(f"{path}: has more than {MAX_FILE_BYTES >> 30} GiB; cut it")
        if path.is_symlink():
            name += os.readlink(path)
        else:
            path.open("rb").close()
    except OSError as error:
        _refuse(error, path)
    if "\n" in name:
        raise InputError(f"{path}: has a line break in its name, or in what it links to; rename it")


def _digest(folder: Path, files: Iterable[Path]) -> str:
    listing = hashlib.sha256()
    beside = folder.parent if folder.is_file() else folder
    for path in files:
        try:
            content = os.readlink(path) if path.is_symlink() else sha256_of(path)
        except OSError as error:
            _refuse(error, path)
        listing.update(os.fsencode(f"{content} {path.relative_to(beside)}\n"))
    return listing.hexdigest()


def _refuse(error: OSError, path: Path | None = None) -> NoReturn:
    raise_if_unreachable(error)
    raise InputError(
        f"{path or error.filename}: cannot be read ({error.strerror}); make it readable or take it out of the folder"
    ) from None

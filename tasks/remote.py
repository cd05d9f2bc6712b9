"""Captures in a bucket: a list of them, and the stage that fetches one into the store.

A capture is identified by the names, sizes and ETags of its files.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hnerf.errors import InputError
from hnerf.progress import tracked
from tasks.bucket import Bucket, RemoteFile
from tasks.packed import require_room
from tasks.source import GoneError
from tasks.stage import stage
from tasks.store import Store


@dataclass(frozen=True)
class RemoteCapture:
    """A capture in a bucket: a folder's URL and its files, without hidden ones."""

    url: str
    files: tuple[RemoteFile, ...]

    @property
    def name(self) -> str:
        """Return the folder's name."""
        return self.url.rpartition("/")[2]

    @property
    def digest(self) -> str:
        """Return a SHA-256 of the files' names, sizes and tags."""
        lines = (f"{file.tag} {file.size_bytes} {file.name}\n" for file in self.files)
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def remote_captures(folder: str) -> Iterator[RemoteCapture]:
    """Yield the captures in the subfolders of a folder, sorted by name."""
    bucket = Bucket.at(folder)
    for name in bucket.folders():
        files = tuple(bucket.files(name))
        if files:
            yield RemoteCapture(f"{folder.rstrip('/')}/{name}", files)


def remote_capture(url: str) -> RemoteCapture:
    """Return the capture at a URL. Raises GoneError if there is no file."""
    capture = RemoteCapture(url.rstrip("/"), tuple(Bucket.at(url).files("")))
    if not capture.files or capture.name in (".", ".."):
        raise GoneError(f"{url}: no such folder; give the capture's folder")
    return capture


def fetched(store: Store, capture: RemoteCapture) -> Path:
    """Return a folder of the store with the capture's files, which are fetched if they are missing."""
    return fetch(store, capture.url, capture.digest).root / capture.name


@stage("fetched", version="1", shared=False)
def fetch(out: Path, url: str, digest: str) -> dict[str, float]:
    """Fetch the capture at a URL, with this digest, from a bucket."""
    capture, bucket = remote_capture(url), Bucket.at(url)
    changed = GoneError(f"{url}: has changed since it was listed; give the same command again")
    size_bytes = sum(file.size_bytes for file in capture.files)
    require_room(size_bytes, out, url)
    for file in tracked(capture.files, "files", len(capture.files)):
        path = out / capture.name / file.name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            bucket.download(file.name, path)
        except FileNotFoundError:
            raise changed from None
        except (FileExistsError, NotADirectoryError, IsADirectoryError):
            raise InputError(f"{url}/{file.name}: is both a file and a folder; rename one") from None
    if {capture.digest, remote_capture(url).digest} != {digest}:
        raise changed
    return {"files": len(capture.files), "megabytes": round(size_bytes / 1e6, 1)}

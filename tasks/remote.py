"""Captures in a bucket: what is there, and the stage that fetches one into the store.

A capture is known by the names, sizes and ETags of its files, on disks by their times instead of ETags.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from hnerf.errors import InputError
from tasks.bucket import Bucket, RemoteFile
from tasks.packed import require_room
from tasks.stage import stage
from tasks.store import Store


@dataclass(frozen=True)
class RemoteCapture:
    """A capture in a bucket: a folder's URL and its files, without hidden ones."""

    url: str
    files: tuple[RemoteFile, ...]

    @property
    def digest(self) -> str:
        """Return a SHA-256 of names and content, the same wherever the folder lies."""
        lines = (f"{file.tag} {file.size_bytes} {file.name}\n" for file in self.files)
        return hashlib.sha256("".join(lines).encode()).hexdigest()

    @property
    def changed_s(self) -> float:
        """Return when a file was last written, in seconds since 1970."""
        return max(file.changed_s for file in self.files)


def remote_captures(folder: str) -> Iterator[RemoteCapture]:
    """Yield the captures in the subfolders of a folder, sorted."""
    bucket, by_name = Bucket.at(folder), dict[str, list[RemoteFile]]()
    for file in bucket.files(""):
        name, _, rest = file.name.partition("/")
        if rest:
            by_name.setdefault(name, []).append(file.named(rest))
    for name, files in sorted(by_name.items()):
        yield RemoteCapture(bucket.where(name), tuple(files))


def remote_capture(url: str) -> RemoteCapture:
    """Return the capture of a URL. Raises InputError if no file is there."""
    files = tuple(Bucket.at(url).files(""))
    if not files:
        raise InputError(f"{url}: no such folder; give the capture's folder")
    return RemoteCapture(url.rstrip("/"), files)


def fetched(store: Store, capture: RemoteCapture) -> Path:
    """Return a folder of the store with the capture's files, fetched unless they are there."""
    artifact = fetch(store, (capture.url, capture.digest))
    return artifact.root / capture.url.rpartition("/")[2]


@stage("fetched", version="1", shared=False)
def fetch(out: Path, named: tuple[str, ...]) -> dict[str, float]:
    """Fetch the capture of a URL and a digest from a bucket."""
    url, digest = named
    capture, bucket = remote_capture(url), Bucket.at(url)
    if capture.digest != digest:
        raise InputError(f"{url}: has changed since it was listed; give the same command again")
    size_bytes = sum(file.size_bytes for file in capture.files)
    require_room(size_bytes, out, url)
    folder = out / url.rpartition("/")[2]
    for file in capture.files:
        if {"", ".", ".."} & set(PurePosixPath(file.name).parts) or file.name.startswith("/"):
            raise InputError(f"{url}: {file.name!r} cannot be the name of a file; rename it")
        path = folder / file.name
        path.parent.mkdir(parents=True, exist_ok=True)
        bucket.download(file.name, path)
    return {"files": len(capture.files), "megabytes": round(size_bytes / 1e6, 1)}

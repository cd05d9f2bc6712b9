"""A place that many machines share: a folder on any file system that fsspec supports, such as an S3 bucket.

Objects must appear whole or not at all, as in object stores; on a local or mounted disk they are renamed into place.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from fsspec import AbstractFileSystem
from fsspec.callbacks import Callback
from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from hnerf.errors import DISK_FULL, InputError, PlaceError, one_line
from hnerf.files import atomic_file
from hnerf.progress import report

VARIABLE = "HNERF_BUCKET"
MAX_NOTE_BYTES = 1000


@dataclass(frozen=True)
class RemoteFile:
    """A file of a bucket. name: relative to a folder; tag: changes with its content."""

    name: str
    size_bytes: int
    tag: str


class BucketError(ConnectionError):
    """The bucket did not respond as expected; a later try may succeed. The message, one line, says why."""


@dataclass(frozen=True)
class Bucket:
    """A folder of a file system. Names are relative to it. Raises BucketError if the file system fails, InputError if
    it denies access to this user, and FileNotFoundError if something does not exist."""

    fs: AbstractFileSystem
    root: str

    @staticmethod
    def configured() -> "Bucket | None":
        """Return the bucket that the environment names, None if it names none. Raises PlaceError if that bucket cannot
        be used."""
        url = os.environ.get(VARIABLE, "")
        try:
            return Bucket.at(url) if url else None
        except InputError as error:
            raise PlaceError(f"{VARIABLE}: {error}") from None

    @staticmethod
    def at(url: str) -> "Bucket":
        """Return the bucket of a URL like s3://bucket/folder or file:///mnt/share. Raises InputError if it does not
        exist or no installed library can open it, and BucketError if it cannot be reached."""
        try:
            if urlsplit(url).password or "::" in url:
                raise InputError("a URL with a password or `::` is refused; give keys by the environment")
            if urlsplit(url).scheme in ("http", "https"):
                raise InputError(
                    f"{url}: is no bucket; download it and give the file, or a URL like s3://bucket/folder"
                )
            # Others write here, too, so listings must not be cached.
            fs, root = url_to_fs(url, use_listings_cache=False)
        except ImportError:
            raise InputError(f"what opens {url} is not installed; for S3, install '.[s3]'") from None
        except (TypeError, ValueError) as error:  # TypeError: a file system that needs more than a URL
            raise InputError(f"{url}: {one_line(error)}; give a URL like s3://bucket/folder") from None
        except InputError:
            raise
        except Exception as error:  # of a file system that connects at once
            raise BucketError(f"{url}: {one_line(error)}; can the bucket be reached?") from error
        bucket = Bucket(fs, root.rstrip("/"))
        if not (bucket.is_disk or urlsplit(url).netloc):  # as of s3://$BUCKET/captures, if that variable is not set
            raise InputError(f"{url}: names no bucket; give a URL like s3://bucket/folder")
        # A path that begins with a bucket's name is in an object store, where folders need not exist.
        top = bucket.root if bucket.root.startswith("/") else bucket.root.split("/")[0]
        with bucket._answering(""):
            try:
                fs.info(top)
            except FileNotFoundError:
                raise PlaceError(f"{url}: {top} is not there; make it, or give another URL") from None
        return bucket

    @property
    def is_disk(self) -> bool:
        """Return whether this is a folder of a local or mounted disk."""
        return isinstance(self.fs, LocalFileSystem)

    def where(self, name: str) -> str:
        """Return the URL of an object."""
        return str(self.fs.unstrip_protocol(self._path(name)))

    def size_bytes(self, name: str) -> int | None:
        """Return the size of an object, None if there is no such object."""
        with self._answering(name), suppress(FileNotFoundError):
            return int(self.fs.info(self._path(name))["size"])
        return None

    def folders(self) -> list[str]:
        """Return the names of the top-level folders, sorted, without hidden ones; none if nothing has been written
        yet."""
        with self._answering(""):
            try:
                entries = self.fs.ls(self.root, detail=True)
            except FileNotFoundError:
                return []
        names = {one["name"].rstrip("/").removeprefix(f"{self.root}/") for one in entries if one["type"] == "directory"}
        return sorted(name for name in names if is_visible(name))

    def files(self, folder: str) -> Iterator[RemoteFile]:
        """Yield the files below a folder of an object store, sorted, without hidden ones and folder markers; none if
        there is no such folder. Raises InputError if the file system does not provide ETags."""
        root = self._path(folder).rstrip("/")
        with self._answering(folder):
            found = self.fs.find(root, detail=True)
        for path, entry in sorted(found.items()):
            name = path.removeprefix(f"{root}/")
            if path.startswith(f"{root}/") and is_visible(name):
                if "ETag" not in entry:
                    raise InputError(f"{self.where(name)}: has no ETag; put captures into a bucket of S3")
                yield RemoteFile(name, int(entry["size"]), entry["ETag"])

    def download(self, name: str, path: Path) -> None:
        """Write an object into a file."""
        progress = Callback(hooks={"": lambda size_bytes, done_bytes: report(name, done_bytes, max(size_bytes, 1))})
        with self._answering(name):
            self.fs.get_file(self._path(name), str(path), callback=progress)

    def upload(self, path: Path, name: str) -> None:
        """Create or replace an object with a file's bytes."""
        with self._answering(name, written=True):
            if not self.is_disk:
                self.fs.put_file(str(path), self._path(name))
                return
            self._make_folder(name)
            with atomic_file(Path(self._path(name))) as beside:
                self.fs.put_file(str(path), str(beside))

    def create_note(self, name: str, text: bytes) -> bool:
        """Create a small object. Return False if it already exists, which the file system decides for all machines."""
        with self._answering(name, written=True):
            self._make_folder(name)
            try:
                with self.fs.open(self._path(name), "xb") as file:
                    file.write(text)
            except FileExistsError:
                return False
            return True

    def write_note(self, name: str, text: bytes) -> None:
        """Create or replace a small object."""
        with self._answering(name, written=True):
            self.fs.pipe_file(self._path(name), text)

    def read_note(self, name: str) -> bytes | None:
        """Return the beginning of a small object, None if there is no such object."""
        with self._answering(name), suppress(FileNotFoundError):  # in one request, since it may be rewritten meanwhile
            return bytes(self.fs.cat_file(self._path(name), end=MAX_NOTE_BYTES))
        return None

    def remove(self, name: str) -> None:
        """Remove an object if it is there."""
        with self._answering(name), suppress(FileNotFoundError):
            self.fs.rm_file(self._path(name))

    def _path(self, name: str) -> str:
        return f"{self.root}/{name}"

    def _make_folder(self, name: str) -> None:
        if self.is_disk:
            self.fs.makedirs(self.fs._parent(self._path(name)), exist_ok=True)

    @contextmanager
    def _answering(self, name: str, written: bool = False) -> Iterator[None]:
        """Turn errors raised inside into ones with a one-line message; file systems raise the errors of many libraries.
        written: if something is missing, it is the bucket itself, not the object."""
        try:
            yield
        except InputError:
            raise
        except FileNotFoundError as error:
            if not written:
                raise
            raise BucketError(f"{self.where(name)}: {one_line(error)}; can the bucket be reached?") from error
        except PermissionError as error:
            raise PlaceError(f"{self.where(name)}: {one_line(error)}; allow this user to read and write it") from error
        except Exception as error:
            full = isinstance(error, OSError) and error.errno in DISK_FULL  # a mounted bucket, or this machine's disk
            advice = "make room" if full else "can the bucket be reached?"
            raise BucketError(f"{self.where(name)}: {one_line(error)}; {advice}") from error


def is_visible(name: str) -> bool:
    """Return whether neither a file nor any folder that contains it is hidden."""
    return all(part and not part.startswith(".") for part in name.split("/"))

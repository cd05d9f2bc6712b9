"""The artifacts that running processes use, recorded so that none is removed while in use.

<store>/.running/<random>  lines `<stage>/<key>`; locked (flock) by a process while it lives, released by the kernel
"""

import errno
import fcntl
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import IO
from uuid import uuid4

from hnerf.errors import PlaceError
from hnerf.files import naming_full_disk

log = logging.getLogger("hnerf.pins")

FOLDER = ".running"
READ_ONLY = (errno.EROFS, errno.EACCES, errno.EPERM)
NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
_own: dict[tuple[int, Path], IO[str]] = {}  # of this process and store; open until the process ends


def pin(store: Path, name: str) -> None:
    """Note that this process uses an artifact from now on. In a read-only store, nothing is noted; warn if others may
    write into it."""
    with unless_read_only(), naming_full_disk(store):
        try:
            file = _own.get((os.getpid(), store)) or _begin(store)
        except PermissionError:
            _warn_of_others(store)
            raise
        file.write(f"{name}\n")
        file.flush()


def pinned(store: Path) -> set[str]:
    """Return the names of the artifacts that living processes use; remove the files of dead ones."""
    names: set[str] = set()
    for path in (store / FOLDER).glob("[0-9a-f]*"):
        try:
            file = path.open("r+")  # NFS locks only files opened for writing
        except FileNotFoundError:  # removed by another process at the same time
            continue
        except OSError as error:
            if error.errno not in READ_ONLY:
                raise
            names |= set(path.read_text().split())
            continue
        with file:
            try:
                flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                names |= set(file.read().split())
            else:
                with unless_read_only():
                    path.unlink(missing_ok=True)
    return names


def flock(file: IO[str], how: int) -> None:
    """Lock a file of the store, as flock(2) does. Raises PlaceError if its file system has no locks."""
    try:
        fcntl.flock(file, how)
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        folder, advice = Path(file.name).parent, "give --store a folder on a local disk or NFS 4"
        raise PlaceError(f"{folder}: its file system has no locks ({error.strerror}); {advice}") from None


@contextmanager
def unless_read_only() -> Iterator[None]:
    """Skip what is done inside if the store is read-only."""
    try:
        yield
    except OSError as error:
        if error.errno not in READ_ONLY:
            raise


@cache
def _warn_of_others(store: Path) -> None:
    log.warning("%s: not writable for this user: `hnerf store gc` of its owner may remove what is being read", store)


def _begin(store: Path) -> IO[str]:
    """Open this process's file, which gets its final name once it is locked."""
    name = uuid4().hex
    beside, path = store / FOLDER / f".{name}", store / FOLDER / name
    beside.parent.mkdir(exist_ok=True)
    file = beside.open("x")
    flock(file, fcntl.LOCK_EX)
    os.replace(beside, path)
    _own[os.getpid(), store] = file
    return file

"""The checkpoint of unfinished work, shared through a bucket, so that another machine can continue where a lost one
was.

    <bucket>/<stage>/<key>.checkpoint    the latest one, until the work is done

Whoever takes over the work checks the content of the checkpoint, as with its own.
"""

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread

from hnerf.errors import InputError
from hnerf.files import replace_text
from tasks.bucket import Bucket
from tasks.packed import require_room
from tasks.store import Store, remove, sha256_of

log = logging.getLogger("hnerf.shared")

LOOK_S = 60.0  # between looks for a new one

Version = tuple[int, int] | None


@contextmanager
def shared_checkpoint(bucket: Bucket, store: Store, stage: str, key: str, file: str) -> Iterator[None]:
    """Start from the bucket's checkpoint if another machine has put one there since this machine last did, else from a
    local one. While the work inside runs, upload new ones. At the end, keep the last one in the bucket if it is still
    needed here. file: its name in the folder of unfinished work."""
    name, path = f"{stage}/{key}.checkpoint", store.path(stage, key, ".partial") / file
    known = store.path(stage, key, ".shared")
    with store.locked(stage, key):
        fetched = _fetch(bucket, name, path, known)
    ended = Event()
    shared = _version(path) if fetched else None
    thread = Thread(target=_share, args=(bucket, name, path, known, shared, ended), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        if not path.exists():
            known.unlink(missing_ok=True)
            _attempt(lambda: bucket.remove(name))


def _fetch(bucket: Bucket, name: str, path: Path, known: Path) -> bool:
    """Take the bucket's checkpoint if there is one that this machine does not know; return whether it was taken. known:
    the file with the digest of the checkpoint that this machine last uploaded or took."""
    if (size_bytes := bucket.size_bytes(name)) is None:
        return False
    if path.parent.is_symlink():
        remove(path.parent)
    path.parent.mkdir(parents=True, exist_ok=True)
    require_room(size_bytes, path.parent, bucket.where(name))
    beside = path.with_name(f"{path.name}.tmp")
    beside.unlink(missing_ok=True)
    try:
        bucket.download(name, beside)
    except FileNotFoundError:  # removed meanwhile
        return False
    digest = sha256_of(beside)
    if path.is_file() and known.is_file() and known.read_text(errors="replace") == digest:
        beside.unlink()
        return False
    log.info("going on from %s (%.1f MB)", bucket.where(name), size_bytes / 1e6)
    replace_text(known, digest)
    os.replace(beside, path)
    return True


def _share(bucket: Bucket, name: str, path: Path, known: Path, shared: Version, ended: Event) -> None:
    """Upload each new checkpoint until the work has ended, then the last one. shared: the version that the bucket
    already has."""
    last = False
    while not last:
        last = ended.wait(LOOK_S)
        found = _version(path)
        if found not in (None, shared) and _attempt(lambda: _put(bucket, name, path, known)):
            shared = found


def _put(bucket: Bucket, name: str, path: Path, known: Path) -> None:
    """Upload the file that is at the path now, whatever replaces it meanwhile."""
    try:
        file = path.open("rb")
    except FileNotFoundError:  # the work is done: there is none any more
        return
    with file:
        opened = Path(f"/dev/fd/{file.fileno()}")
        bucket.upload(opened, name)
        replace_text(known, sha256_of(opened))


def _version(path: Path) -> Version:
    """Return a value that changes with each new file at a path; None if there is no file."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_ino, found.st_mtime_ns


def _attempt(act: Callable[[], None]) -> bool:
    """Call `act`; return whether bucket and disk allowed it. If not, warn: the work continues without."""
    try:
        act()
    except (OSError, InputError) as error:
        log.warning("%s", error)
        return False
    return True

"""Artifacts and leftovers in a store that nobody needs, and their removal while flows are running.

An artifact is needed if a subject's latest results link to it or were computed from it, or if a running process uses
it. A use is recorded twice: in the process's own file (tasks/pins.py), and as the modification time of the artifact's
record. Removal first moves the record aside, and puts it back if its time has changed since it was read. So either the
process finds no record, or its use is noticed here.
"""

import fcntl
import os
import re
import stat
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tasks.inventory import KEY, Inventory, in_stages
from tasks.store import Store, remove

LEFT = re.compile(rf"({KEY.pattern})(\.partial|\.json\.partial|\.moving|\.old|\.shared|\.lock|\.json|)")


@dataclass(frozen=True)
class Garbage:
    """Something to remove: the artifact of a key or, if `left` has paths, the remains of interrupted work on it or of
    an artifact that cannot be found any more. used_s: when it was last used or written, in seconds since 1970."""

    stage: str
    key: str
    left: tuple[Path, ...]
    size_bytes: int
    used_s: float

    @property
    def what(self) -> str:
        """Return a word for what it is."""
        return "leftover" if self.left else "artifact"


def find_garbage(inventory: Inventory, keep: int, older_s: float) -> list[Garbage]:
    """Return the artifacts that no subject needs for its `keep` newest results, the remains of interrupted work, and
    what cannot be found any more. Leave out what was used in the last `older_s` seconds, or is being worked on."""
    needed = inventory.needed(keep)
    found = [
        Garbage(one.artifact.stage, one.artifact.root.name, (), one.size_bytes, one.used_s)
        for name, one in inventory.stored.items()
        if name not in needed
    ]
    found += _left_behind(inventory)
    old = [one for one in found if not older_s or one.used_s <= time.time() - older_s]  # clocks may have been ahead
    return [one for one in old if not _is_locked(inventory.store.path(one.stage, one.key, ".lock"))]


def collect(store: Store, garbage: Garbage) -> bool:
    """Remove it. Return False, and leave everything in place, if a process works on the key or has used it
    meanwhile."""
    try:
        with store.locked(garbage.stage, garbage.key, wait=False):
            return _remove_left(store, garbage) if garbage.left else _remove_artifact(store, garbage)
    except BlockingIOError:
        return False


def _remove_artifact(store: Store, garbage: Garbage) -> bool:
    record, aside, folder = (store.path(garbage.stage, garbage.key, end) for end in (".json", ".json.partial", ""))
    try:
        os.replace(record, aside)
    except FileNotFoundError:
        return False
    if aside.stat().st_mtime != garbage.used_s:
        os.replace(aside, record)
        return False
    remove(folder)
    aside.unlink()
    return True


def _remove_left(store: Store, garbage: Garbage) -> bool:
    own = {store.path(garbage.stage, garbage.key, end) for end in ("", ".json")}
    finished = not own.isdisjoint(garbage.left) and _can_be_found(store, garbage)  # it was about to be recorded
    if finished or _written_s(garbage.left) > garbage.used_s:  # it was resumed, and interrupted again
        return False
    for path in garbage.left:
        if path.is_dir() and not path.is_symlink():
            remove(path)
        elif path.suffix != ".lock":  # the lock is held, and removed last (Store.locked)
            path.unlink(missing_ok=True)
    return True


def _is_locked(lock: Path) -> bool:
    """Return whether a process holds a lock, as one that works on the key does. The lock is left unchanged."""
    if lock.is_symlink() or not lock.is_file():
        return False
    with suppress(OSError), lock.open() as file:  # removed meanwhile, or not readable
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _can_be_found(store: Store, garbage: Garbage) -> bool:
    try:
        artifact = store.recorded(garbage.stage, garbage.key)
    except FileNotFoundError:
        return False
    return artifact is not None and artifact.root.is_dir()


def _left_behind(inventory: Inventory) -> Iterator[Garbage]:
    """Yield, by key, leftovers that are not in use: folders without a record, work in progress, locks of keys that have
    nothing else, and records that cannot be read or have no folder."""
    used = inventory.used
    lost = {record for record in inventory.unreadable if f"{record.parent.name}/{record.stem}" not in used}
    left: dict[tuple[str, str], list[Path]] = {}
    for path in in_stages(inventory.store, "*"):
        matched = LEFT.fullmatch(path.name)
        if not matched:
            continue
        record = path.with_name(f"{matched[1]}.json")
        if matched[2] not in ("", ".json") or record in lost or not record.exists():
            left.setdefault((path.parent.name, matched[1]), []).append(path)
    for (stage, key), paths in left.items():
        if f"{stage}/{key}" in used:  # the stage failed and waits for its next try
            continue
        recorded = inventory.store.path(stage, key, ".json").exists()
        if not (recorded and all(path.suffix == ".lock" for path in paths)):
            size_bytes = sum(found.st_size for found in _stats(paths) if stat.S_ISREG(found.st_mode))
            yield Garbage(stage, key, tuple(paths), size_bytes, _written_s(paths))


def _written_s(paths: Iterable[Path]) -> float:
    """Return when any of these files, or a file in these folders, was last written; 0 if none is left."""
    return max((found.st_mtime for found in _stats(paths)), default=0.0)


def _stats(paths: Iterable[Path]) -> Iterator[os.stat_result]:
    """Yield the state of these files and folders, and of all in them, that still exist; without locks."""
    for one in [inner for path in paths if path.suffix != ".lock" for inner in [path, *path.rglob("*")]]:
        with suppress(FileNotFoundError):
            yield one.lstat()

"""The artifact store: each stage's output under a key that is derived from its inputs.

    <store>/<stage>/<key>/          the files, put there by a single rename
    <store>/<stage>/<key>.json      the record: each file's SHA-256 and size, and a few metrics
    <store>/<stage>/<key>.partial/  work in progress
    <store>/<stage>/<key>.moving/   on its way into or out of a bucket (tasks/shared.py) or archive (tasks/archive.py)
    <store>/<stage>/<key>.old/      damaged files that were replaced, until they are removed
    <store>/<stage>/<key>.shared    which of its checkpoints a bucket has (tasks/shared_checkpoint.py)
    <store>/<stage>/<key>.lock      locked (flock) by a process that works on the key; if it dies, the kernel unlocks it
    <store>/subjects/<name>/<stage> -> the latest artifact of a subject
    <store>/subjects/<name>/.recording  the digest and the folder of the recording that these come from
    <store>/<study>/<table>.recording  the same for a study's table, where <study> is ablations, benchmark or stability
    <store>/.running/                which artifacts each running process uses (tasks/pins.py)

The record's modification time is the time of its last use (tasks/garbage.py).

Only the store decides what can be reused; Prefect's record of a task run is a view of it (tasks/policy.py).
"""

import errno
import fcntl
import hashlib
import json
import logging
import math
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Annotated
from uuid import uuid4

from pydantic import BaseModel, Field, FiniteFloat

from hnerf.errors import InputError, PlaceError
from hnerf.files import atomic_file, made_folder, naming_full_disk, replace_text
from tasks.pins import flock, pin, unless_read_only

log = logging.getLogger("hnerf.store")

RECORDING = ".recording"  # under subjects/<name>: digest and folder of the recording
SUFFIXES = ("", ".json", ".json.partial", ".partial", ".moving", ".old", ".shared")  # a key may have, besides its lock
MAX_LINKS = 40  # one after another, as for the kernel
MAX_RECORD_BYTES = 256_000_000  # a million files need half of this
ATTEMPTS = 100  # to lock a key in a folder that other processes create and remove
# In order: each stage is computed from those before it.
STAGES = (
    "cameras",
    "capture",
    "detection",
    "hands",
    "calibration",
    "segmentation",
    "fit",
    "training",
    "evaluation",
    "asset",
)
OPTIONAL = {"cameras", "detection", "hands"}  # stages that a run may skip

NAME = re.compile(r"[a-z][a-z-]{0,30}/[0-9a-f]{32}")  # of an artifact


class StoredFile(BaseModel):
    """The digest and the size with which a file of an artifact is checked."""

    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    size_bytes: Annotated[int, Field(ge=0, lt=2**63)]


class Artifact(BaseModel):
    """The finished output of one stage. files: by path relative to `root`; metrics: a few headline numbers; inputs:
    `<stage>/<key>` of the artifacts that it was computed from; records of earlier versions lack them."""

    stage: str
    root: Path
    files: dict[str, StoredFile]
    metrics: dict[str, FiniteFloat] = {}
    inputs: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Return `<stage>/<key>`."""
        return f"{self.stage}/{self.root.name}"

    @property
    def digest(self) -> str:
        """Return the SHA-256 of the files' names and bytes, on which the keys of later stages depend."""
        listing = "".join(f"{file.sha256} {name}\n" for name, file in sorted(self.files.items()))
        return hashlib.sha256(listing.encode()).hexdigest()

    def damaged_file(self) -> Path | None:
        """Return the first recorded file that is missing or has changed; None if there is none."""
        for name, file in self.files.items():
            path = self.root / name
            if not path.is_file() or path.stat().st_size != file.size_bytes or sha256_of(path) != file.sha256:
                return path
        return None


@dataclass(frozen=True)
class Store:
    """A folder of artifacts, shared by any number of processes."""

    root: Path

    def exists(self) -> bool:
        """Return whether anything was ever stored here: whether a subfolder exists that only a store has. A cameras/
        does not count, since `hnerf calibrate` writes one, too."""
        return any((self.root / name).is_dir() for name in ("subjects", "ingested", "capture", "fetched", ".running"))

    def find(self, stage: str, key: str) -> Artifact | None:
        """Return the artifact if it is recorded and intact, else None. From now on, it counts as used by this
        process."""
        record = self.path(stage, key, ".json")
        if not record.is_file():  # reading a pipe or a device would never end
            return None
        pin(self.root, f"{stage}/{key}")
        try:
            with unless_read_only():
                os.utime(record, follow_symlinks=False)
            artifact = self.recorded(stage, key)
        except FileNotFoundError:
            return None
        damaged = artifact.damaged_file() if artifact else record
        if damaged is None:
            return artifact
        log.warning("%s is damaged or missing: %s will be computed again", damaged, stage)
        return None

    def intact(self, stage: str, key: str) -> Artifact:
        """Return the artifact; raise InputError if it is damaged or missing."""
        found = self.find(stage, key)
        if found is None:
            raise InputError(f"{self.path(stage, key)}: damaged; repeat the same `hnerf run`, which computes it again")
        return found

    def recorded(self, stage: str, key: str) -> Artifact | None:
        """Return the artifact as its record describes it, without a check of its files. Return None if the record
        cannot be read as one, is a link, or is too large. Raises FileNotFoundError if there is no record."""
        record, root = self.path(stage, key, ".json"), self.path(stage, key)
        if record.is_symlink() or root.is_symlink() or record.stat().st_size > MAX_RECORD_BYTES:
            return None
        try:
            artifact = Artifact.model_validate({"root": root, **json.loads(record.read_bytes())})
        except (RecursionError, TypeError, ValueError):  # TypeError: JSON, but not an object
            return None
        named = all(NAME.fullmatch(name) for name in artifact.inputs)
        return artifact if named and artifact.stage == stage else None

    def get_or_compute(
        self,
        stage: str,
        key: str,
        write: Callable[[Path], dict[str, float]],
        resumable: bool = False,
        inputs: Iterable[str] = (),
        checkpoint: str = "",
    ) -> Artifact:
        """Return the stored artifact, or compute it with `write(folder)`, which returns its metrics. Only finite
        metrics are kept.

        If several callers want the same artifact, one computes it and the others wait. The folder of a resumable stage
        survives a crash, and the next call resumes in it; other stages start with an empty one. Links in place of files
        are not followed. A store that has the artifact may be read-only. inputs: names of the artifacts that `write`
        reads; checkpoint: files in the folder whose names begin with this are not part of the artifact, and stay until
        it is recorded.
        """
        if found := self.find(stage, key):
            if checkpoint:  # left by a process that was killed between the last steps of its commit
                remove_checkpoint(found.root, checkpoint)
            return found
        partial = self.path(stage, key, ".partial")
        with self.locked(stage, key):
            found = self.find(stage, key)
            if found:
                return found
            if not resumable or partial.is_symlink():
                remove(partial)
            for path in partial.rglob("*"):
                if path.is_symlink():
                    path.unlink()
            partial.mkdir(parents=True, exist_ok=True)
            try:
                with naming_full_disk(self.root):
                    metrics = write(partial)
            except BaseException as error:
                if not resumable or (isinstance(error, InputError) and not isinstance(error, PlaceError)):
                    remove(partial)
                else:
                    with suppress(OSError):  # an error here would hide the one that ended the work
                        pin(self.root, f"{stage}/{key}")  # not garbage while this process may try again
                raise
            finite = {name: value for name, value in metrics.items() if math.isfinite(value)}  # JSON has no others
            made = Artifact(stage=stage, root=self.path(stage, key), files={}, metrics=finite,
                            inputs=tuple(sorted(set(inputs))))  # fmt: skip
            return self.commit(made, checkpoint)

    def link_latest(self, subject: str, artifact: Artifact) -> Artifact:
        """Point `<store>/subjects/<subject>/<stage>` at the artifact; return it."""
        if subject in ("", ".", "..") or "/" in subject:
            raise InputError(f"capture.toml: name {subject!r} cannot be the name of a folder; choose another")
        link = self.subject_folder(subject) / artifact.stage
        target = os.path.relpath(artifact.root, link.parent)
        if link.is_symlink() and os.readlink(link) == target:
            return artifact
        link.parent.mkdir(parents=True, exist_ok=True)
        # Results computed from an earlier artifact, or without one, no longer belong to the subject.
        self._unlink_from(subject, STAGES.index(artifact.stage) + 1)
        with atomic_file(link) as beside:
            beside.symlink_to(target)
        return artifact

    def unlink_latest(self, subject: str, stages: Iterable[str]) -> None:
        """Remove a subject's links to artifacts of these stages, which the latest run skipped, and to what was computed
        from them."""
        for stage in stages:
            if (self.subject_folder(subject) / stage).is_symlink():
                self._unlink_from(subject, STAGES.index(stage))

    def _unlink_from(self, subject: str, first: int) -> None:
        for stage in STAGES[first:]:
            (self.subject_folder(subject) / stage).unlink(missing_ok=True)

    def claim(self, subject: str, digest: str, folder: Path | str) -> None:
        """Note the recording to which the results under a subject's name belong. Warn if they belonged to another
        recording in another folder until now: two recordings with the same name replace each other's results."""
        path, claimed = self.subject_folder(subject) / RECORDING, f"{digest}\n{folder}\n"
        path.parent.mkdir(parents=True, exist_ok=True)
        before = _text(path)
        if other := _other_recording(before, digest, folder):
            log.warning(
                "%s showed the results of %s and will show those of %s; give one of them another name in capture.toml",
                path.parent, other, folder,
            )  # fmt: skip
        if before != claimed:
            with unless_read_only():
                replace_text(path, claimed)

    def claim_table(self, table: Path, digest: str, folder: Path) -> None:
        """Note next to a study's table which recording it belongs to, and create its folder. Raises InputError if there
        is a table of another recording in another folder, which would be overwritten."""
        note = table.with_suffix(RECORDING)
        if table.exists() and (other := _other_recording(_text(note), digest, folder)):
            raise InputError(
                f"{table}: is of {other}, not of {folder}; give one of them another name in capture.toml, or give "
                "--store another folder"
            )
        table.parent.mkdir(parents=True, exist_ok=True)
        replace_text(note, f"{digest}\n{folder}\n")

    def subject_folder(self, subject: str) -> Path:
        """Return the folder with links to a subject's latest artifacts."""
        return self.root / "subjects" / subject

    def recording(self, subject: str) -> str:
        """Return the digest and the folder of a subject's recording, each on a line; empty if they are not known."""
        return _text(self.subject_folder(subject) / RECORDING)

    def recording_folder(self, subject: str) -> str:
        """Return the folder or URL of the recording that a subject's results come from; empty if it is not known."""
        return self.recording(subject).partition("\n")[2].strip()

    def path(self, stage: str, key: str, suffix: str = "") -> Path:
        """Return the path of an artifact, or of a file that belongs to it (.json, .partial, .lock)."""
        return self.root / stage / f"{key}{suffix}"

    @contextmanager
    def locked(self, stage: str, key: str, wait: bool = True) -> Iterator[None]:
        """Hold the lock of a key. If `wait` is false, raise BlockingIOError instead of waiting for it. If the key has
        no files in the end, remove the lock, too, and the folders that were created for it."""
        path = self.path(stage, key, ".lock")
        for attempt in count(1):
            with ExitStack() as held:
                try:
                    held.enter_context(made_folder(path.parent))
                    lock = held.enter_context(open(path, "w", opener=_without_following))
                except (FileNotFoundError, FileExistsError):  # another process removes the empty folder that it created
                    if attempt == ATTEMPTS:
                        raise
                    continue
                try:
                    flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    if not wait:
                        raise
                    log.info("waiting for another process that is working on %s %s", stage, key)
                    flock(lock, fcntl.LOCK_EX)
                if not _is_at(path, lock.fileno()):
                    continue  # the process that held it has removed it
                try:
                    yield
                finally:
                    if not any(os.path.lexists(self.path(stage, key, suffix)) for suffix in SUFFIXES):
                        path.unlink(missing_ok=True)
                return

    @contextmanager
    def scratch(self, stage: str, key: str) -> Iterator[Path]:
        """Create a folder for files on their way in or out, and hold the lock of the key while it exists."""
        with self.locked(stage, key):
            folder = self.path(stage, key, ".moving")
            remove(folder)
            folder.mkdir()
            try:
                yield folder
            finally:
                remove(folder)

    def commit(self, artifact: Artifact, checkpoint: str = "") -> Artifact:
        """Record the files in the artifact's `.partial` folder, and put them in place; its lock must be held. Files
        whose names begin with `checkpoint` are deleted last. From now on, the artifact counts as used by this
        process."""
        pin(self.root, artifact.name)
        stage, key = artifact.stage, artifact.root.name
        partial, folder, record, old = (self.path(stage, key, suffix) for suffix in (".partial", "", ".json", ".old"))
        kept = set(partial.glob(f"{checkpoint}*")) if checkpoint else set()
        paths = sorted(set(partial.rglob("*")) - kept)
        sizes_bytes = {path: _flush(path) for path in [partial, *paths]}
        files = {
            str(path.relative_to(partial)): StoredFile(sha256=sha256_of(path), size_bytes=sizes_bytes[path])
            for path in paths
            if path.is_file()
        }
        artifact = artifact.model_copy(update={"files": files})
        beside = self.path(stage, key, ".json.partial")
        beside.unlink(missing_ok=True)
        with beside.open("x") as file:
            file.write(artifact.model_dump_json(indent=1, exclude={"root"}))
        _flush(beside)
        if os.path.lexists(folder):  # out of the way at once: it may not be possible to empty it while files are open
            remove(old)
            old.mkdir(exist_ok=True)
            os.replace(folder, old / uuid4().hex)
        # The record comes first: if the process is killed before the folder is in place, the work can be resumed.
        os.replace(beside, record)
        os.replace(partial, folder)
        remove(old)
        if checkpoint:
            remove_checkpoint(folder, checkpoint)
        _flush(folder.parent)
        return artifact


def remove_checkpoint(folder: Path, name: str) -> None:
    """Remove the files whose names begin with `name` from an artifact's folder, unless it is read-only."""
    for path in folder.glob(f"{name}*"):
        with unless_read_only():
            path.unlink(missing_ok=True)


def require_intact(subject: Path) -> None:
    """Raise InputError if an artifact to which `<store>/subjects/<name>` links has changed since it was recorded."""
    for link in sorted(subject.iterdir()):
        root = _linked(link)
        if link.name in STAGES and root.with_name(f"{root.name}.json").is_file():
            Store(root.parents[1]).intact(link.name, root.name)


def recording_digest(subject: Path) -> str:
    """Return the digest of the recording that `<store>/subjects/<name>` was trained on; "" if there is no record of
    it."""
    for stage in ("hands", "detection", "capture"):  # the last of them that ran
        root = _linked(subject / stage)
        if root.is_dir():
            found = Store(root.parents[1]).find(stage, root.name)
            return found.digest if found else ""
    return ""


def _linked(link: Path) -> Path:
    """Return the place in the store to which a subject's link leads; the folder of its stage may be a link to another
    disk, which is not followed."""
    place = link.parent.resolve() / link.name
    for _ in range(MAX_LINKS):
        if place.is_symlink():
            place = Path(os.path.normpath(place.parent / os.readlink(place)))
    return place


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def remove(folder: Path) -> None:
    """Remove a folder with its contents; if a link is in its place, remove the link, not its target."""
    if folder.is_symlink():
        folder.unlink()
    else:
        shutil.rmtree(folder, ignore_errors=True)


def _text(note: Path) -> str:
    """Return the text of a note in the store; empty if there is none, or if a link is in its place."""
    return note.read_text(errors="replace") if note.is_file() and not note.is_symlink() else ""


def _other_recording(note: str, digest: str, folder: Path | str) -> str:
    """Return the folder that a note names if it is about a recording with other content in another folder; else
    nothing."""
    noted, _, other = note.strip().partition("\n")
    return "" if noted == digest or other == str(folder) else " ".join(other.splitlines())


def _is_at(path: Path, descriptor: int) -> bool:
    """Return whether an open file is the one that is now at a path."""
    try:
        return os.path.samestat(os.stat(path, follow_symlinks=False), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _without_following(name: str, flags: int) -> int:
    """Open a file of the store. Raises InputError if a link is in its place."""
    try:
        return os.open(name, flags | os.O_NOFOLLOW, 0o666)
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise InputError(f"{name}: is a symbolic link; remove it from the store") from None


def _flush(path: Path) -> int:
    """Flush a file or folder to disk (fsync); return its size in bytes."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
        return os.fstat(descriptor).st_size
    finally:
        os.close(descriptor)

"""A subject as one file: a tar archive of `manifest.json` and of each file once, named by its SHA-256.

Names in the archive are digests, and paths come from the manifest alone, which is checked as a whole first: so nothing
in an archive can name a place outside the store.
"""

import hashlib
import io
import json
import os
import shutil
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO, Annotated

from pydantic import Field, model_validator

from hnerf.config import Section, validated
from hnerf.errors import InputError
from hnerf.files import made_folder
from tasks.inventory import Inventory
from tasks.store import RECORDING, STAGES, Artifact, Store, remove

MANIFEST = "manifest.json"
MAX_MANIFEST_BYTES = 64 << 20  # 200 bytes a file
BLOCK = tarfile.BLOCKSIZE
CHUNK_BYTES = 1 << 20
MAX_PATH_BYTES = 1024
SPARE_BYTES = 1 << 30  # of the disk, which an import leaves free

Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z-]{0,30}/[0-9a-f]{32}$")]  # of an artifact


class ArchivedFile(Section):
    """The digest and size of a file."""

    sha256: Digest
    size_bytes: int = Field(ge=0)


class ArchivedArtifact(Section):
    """An artifact's record; files by their path in its folder."""

    files: dict[str, ArchivedFile]
    metrics: dict[str, float] = Field(default_factory=dict)
    inputs: tuple[Name, ...] = ()

    @model_validator(mode="after")
    def _paths_stay_inside(self) -> "ArchivedArtifact":
        for path in self.files:
            parts = PurePosixPath(path).parts
            above = {"/".join(parts[:depth]) for depth in range(1, len(parts))}
            encoded = path.encode(errors="replace")
            plain = "/".join(parts) == path == encoded.decode() and "\0" not in path
            if not (parts and plain) or parts[0] == "/" or ".." in parts or above & self.files.keys():
                raise ValueError(f"{path!r} is not a path inside a folder")
            if len(encoded) > MAX_PATH_BYTES:
                raise ValueError(f"{path[:80]!r}... is not a path inside a folder: too long")
        return self


class Manifest(Section):
    """What an archive holds. recording: the lines of the subject's `.recording`; latest: artifact of each stage."""

    subject: Annotated[str, Field(pattern=r"^[^/]{1,200}$")]
    recording: Annotated[str, Field(pattern=r"^([0-9a-f]{64}\n[^\n]*\n)?$")]
    latest: dict[str, Name]
    artifacts: dict[Name, ArchivedArtifact]

    @model_validator(mode="after")
    def _links_lead_to_what_is_here(self) -> "Manifest":
        if self.subject in (".", "..") or not self.subject.isprintable():
            raise ValueError(f"{self.subject!r} cannot be the name of a folder")
        for stage, name in self.latest.items():
            if stage not in STAGES or name not in self.artifacts or name.partition("/")[0] != stage:
                raise ValueError(f"latest: {stage}: no such artifact")
        return self

    def sizes_bytes(self) -> dict[str, int]:
        """Return the size of each file by its digest."""
        files = [file for artifact in self.artifacts.values() for file in artifact.files.values()]
        return {file.sha256: file.size_bytes for file in files}


def export_subject(store: Store, subject: str, out: Path) -> Manifest:
    """Write a subject's latest artifacts, with all that they were computed from, into a new file. Raises InputError if
    there is no such subject, an artifact is damaged, or `out` exists."""
    if out.exists():
        raise InputError(f"{out}: exists; give the name of a new file")
    inventory = Inventory.of(store)
    latest = {stage: name for stage, name in inventory.latest.get(subject, {}).items() if name in inventory.stored}
    if not latest:
        raise InputError(f"{store.subject_folder(subject)}: no results; `hnerf store list` names the subjects")
    artifacts = [_intact(store, *name.split("/")) for name in sorted(inventory.with_inputs(latest.values()))]
    manifest = Manifest(
        subject=subject,
        recording=(store.subject_folder(subject) / RECORDING).read_text() if _has_recording(store, subject) else "",
        latest=latest,
        artifacts={
            one.name: ArchivedArtifact.model_validate(one.model_dump(include={"files", "metrics", "inputs"}))
            for one in artifacts
        },
    )
    paths = {file.sha256: one.root / path for one in artifacts for path, file in one.files.items()}
    text = manifest.model_dump_json().encode()
    beside = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        with tarfile.open(beside, "x", format=tarfile.GNU_FORMAT) as archive:
            _add(archive, MANIFEST, len(text), io.BytesIO(text))
            for digest, size_bytes in manifest.sizes_bytes().items():
                with paths[digest].open("rb") as file:
                    _add(archive, digest, size_bytes, file)
        os.replace(beside, out)
    finally:
        beside.unlink(missing_ok=True)
    return manifest


def import_subject(store: Store, path: Path) -> Manifest:
    """Put an archive's artifacts into the store, each as if it had been computed there, and link the subject to them.

    What the store has already stays. Raises InputError, and links nothing, if the file is no such archive, is damaged,
    would fill the disk, or if the subject's name belongs to another recording here.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; give an archive of `hnerf store export`")
    with (
        made_folder(store.root),
        path.open("rb") as archive,
        tempfile.TemporaryDirectory(dir=store.root, prefix=".import-") as scratch,
    ):
        manifest = _read_manifest(archive, path)
        _check_place(manifest, store, path)
        _unpack(archive, manifest, Path(scratch), path)
        for name, one in manifest.artifacts.items():
            _place(store, name, one, Path(scratch))
        if manifest.recording:
            digest, _, folder = manifest.recording.strip().partition("\n")
            store.claim(manifest.subject, digest, Path(folder))
        for stage in sorted(manifest.latest, key=STAGES.index):
            store.link_latest(manifest.subject, _intact(store, *manifest.latest[stage].split("/")))
    return manifest


def _has_recording(store: Store, subject: str) -> bool:
    path = store.subject_folder(subject) / RECORDING
    return path.is_file() and not path.is_symlink()


def _intact(store: Store, stage: str, key: str) -> Artifact:
    found = store.find(stage, key)
    if found is None:
        raise InputError(f"{store.path(stage, key)}: damaged; repeat the same `hnerf run`, which computes it again")
    return found


def _add(archive: tarfile.TarFile, name: str, size_bytes: int, content: IO[bytes]) -> None:
    member = tarfile.TarInfo(name)
    member.size = size_bytes
    archive.addfile(member, content)


def _read_manifest(archive: IO[bytes], path: Path) -> Manifest:
    name, size_bytes = next(_members(archive, path), ("", 0))
    if name != MANIFEST or size_bytes > MAX_MANIFEST_BYTES:
        raise InputError(f"{path}: does not begin with a manifest; give an archive of `hnerf store export`")
    try:
        tree = json.loads(archive.read(size_bytes))
    except (RecursionError, ValueError):
        raise InputError(f"{path}: its manifest is damaged; export it again") from None
    archive.seek(-size_bytes % BLOCK, os.SEEK_CUR)
    return validated(Manifest, tree, path)


def _check_place(manifest: Manifest, store: Store, path: Path) -> None:
    """Raise InputError if the files would fill the disk, or the subject's name belongs to another recording."""
    # Every path counts, and not only every file: each is read to check its digest.
    wanted = sum(file.size_bytes for one in manifest.artifacts.values() for file in one.files.values())
    free = shutil.disk_usage(store.root).free
    if wanted > free - SPARE_BYTES:
        raise InputError(f"{path}: unpacks to {wanted / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free; make room")
    here = store.subject_folder(manifest.subject)
    if here.is_dir() and any(here.iterdir()):
        recording = (here / RECORDING).read_text() if _has_recording(store, manifest.subject) else ""
        if recording.partition("\n")[0] != manifest.recording.partition("\n")[0] or not recording:
            raise InputError(f"{here}: has the results of another recording; import into another store")


def _unpack(archive: IO[bytes], manifest: Manifest, scratch: Path, path: Path) -> None:
    """Write each file into `scratch` under its digest, which is checked."""
    missing = manifest.sizes_bytes()
    for digest, size_bytes in _members(archive, path):
        if missing.pop(digest, -1) != size_bytes:
            raise InputError(f"{path}: holds {digest!r}, which its manifest does not name; export it again")
        seen = hashlib.sha256()
        with (scratch / digest).open("xb") as file:
            for start in range(0, size_bytes, CHUNK_BYTES):
                chunk = archive.read(min(CHUNK_BYTES, size_bytes - start))
                seen.update(chunk)
                file.write(chunk)
        archive.seek(-size_bytes % BLOCK, os.SEEK_CUR)
        if seen.hexdigest() != digest:
            raise InputError(f"{path}: is damaged or cut short; copy it again")
    if missing:
        raise InputError(f"{path}: {len(missing)} files are missing at its end; copy it again")


def _members(archive: IO[bytes], path: Path) -> Iterator[tuple[str, int]]:
    """Yield name and size of each member; its content must be read, up to the next block, before the next is asked for.

    Only plain files are members: no links, devices, folders, or headers of variable size, which a general reader takes
    into memory.
    """
    while block := archive.read(BLOCK):
        if not any(block):
            return
        try:
            member = tarfile.TarInfo.frombuf(block, "ascii", "strict")
        except (tarfile.HeaderError, UnicodeError, ValueError):
            raise InputError(f"{path}: is not an archive of `hnerf store export`, or damaged") from None
        if member.type != tarfile.REGTYPE or member.size < 0:
            raise InputError(f"{path}: {member.name!r} is not a plain file; give an archive of `hnerf store export`")
        yield member.name, member.size


def _place(store: Store, name: str, archived: ArchivedArtifact, scratch: Path) -> None:
    """Take an artifact's files out of `scratch` and record it, unless the store has it."""
    stage, key = name.split("/")
    with store.locked(stage, key):
        if store.find(stage, key):
            return
        partial = store.path(stage, key, ".partial")
        remove(partial)
        partial.mkdir()
        for inside, file in archived.files.items():
            (partial / inside).parent.mkdir(parents=True, exist_ok=True)
            os.link(scratch / file.sha256, partial / inside)
        root, described = store.path(stage, key), archived.model_dump(include={"metrics", "inputs"})
        store.commit(Artifact(stage=stage, root=root, files={}, **described))

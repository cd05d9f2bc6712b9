"""Artifacts packed into one file: a tar archive of a manifest and of each distinct file once. Members are named by
their SHA-256.

Paths come only from the manifest, all of which is checked first, so that nothing in an archive can name a place outside
the store.
"""

import hashlib
import io
import json
import os
import re
import shutil
import tarfile
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import IO, Annotated, TypeVar

from pydantic import Field, model_validator

from hnerf.config import Section, validated
from hnerf.errors import InputError, PlaceError
from tasks.store import NAME, Artifact, Store, StoredFile, remove

MANIFEST = re.compile(r"[0-9a-f]{64}\.json")
MAX_MANIFEST_BYTES = 64 << 20  # 200 bytes a file
BLOCK = tarfile.BLOCKSIZE
CHUNK_BYTES = 1 << 20
MAX_PATH_BYTES, MAX_NAME_BYTES = 1024, 255  # the latter of a single folder or file
SPARE_BYTES = 1 << 30  # on the disk, which an archive must leave free

Name = Annotated[str, Field(pattern=f"^{NAME.pattern}$")]


class ArchivedArtifact(Section):
    """An artifact's record. files: by their path in its folder."""

    files: dict[str, StoredFile]
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
            if len(encoded) > MAX_PATH_BYTES or max(len(part.encode()) for part in parts) > MAX_NAME_BYTES:
                raise ValueError(f"{path[:80]!r}... is not a path inside a folder: too long")
        return self


class Contents(Section):
    """The contents of an archive: artifacts by name."""

    artifacts: dict[Name, ArchivedArtifact]

    def sizes_bytes(self) -> dict[str, int]:
        """Return the size of each file, by its digest."""
        files = [file for artifact in self.artifacts.values() for file in artifact.files.values()]
        return {file.sha256: file.size_bytes for file in files}

    def unpacked_bytes(self) -> int:
        """Return the size of the unpacked artifacts. A file counts once for each of its paths, since every path is read
        to check its digest."""
        return sum(file.size_bytes for one in self.artifacts.values() for file in one.files.values())


Kind = TypeVar("Kind", bound=Contents)


def archived(artifacts: Iterable[Artifact]) -> dict[str, ArchivedArtifact]:
    """Return the manifest's description of artifacts."""
    return {
        one.name: validated(ArchivedArtifact, one.model_dump(include={"files", "metrics", "inputs"}), one.root)
        for one in artifacts
    }


def pack(contents: Contents, store: Store, out: Path) -> None:
    """Write a new file with these artifacts of the store."""
    paths = {
        file.sha256: store.root / name / path
        for name, one in contents.artifacts.items()
        for path, file in one.files.items()
    }
    text = contents.model_dump_json().encode()
    with tarfile.open(out, "x", format=tarfile.GNU_FORMAT) as archive:
        _add(archive, manifest_name(text), len(text), io.BytesIO(text))
        for digest, size_bytes in contents.sizes_bytes().items():
            with paths[digest].open("rb") as file:
                _add(archive, digest, size_bytes, file)


def manifest_name(text: bytes) -> str:
    """Return the name of the member that holds a manifest."""
    return f"{hashlib.sha256(text).hexdigest()}.json"


def read_contents(kind: type[Kind], archive: IO[bytes], where: str) -> Kind:
    """Read the manifest at the beginning of an archive. where: the archive's name in errors."""
    name, size_bytes = next(_members(archive, where), ("", 0))
    if not MANIFEST.fullmatch(name) or size_bytes > MAX_MANIFEST_BYTES:
        raise InputError(f"{where}: does not begin with a manifest; give an archive of `hnerf store export`")
    text = archive.read(size_bytes)
    try:
        tree = json.loads(text)
    except (RecursionError, ValueError):
        tree = None
    if tree is None or manifest_name(text) != name:
        raise InputError(f"{where}: its manifest is damaged; export it again")
    archive.seek(-size_bytes % BLOCK, os.SEEK_CUR)
    return validated(kind, tree, where)


def require_room(wanted_bytes: int, folder: Path, where: str) -> None:
    """Raise PlaceError if this many bytes would fill the disk."""
    free = shutil.disk_usage(folder).free
    if wanted_bytes > free - SPARE_BYTES:
        raise PlaceError(f"{where}: takes {wanted_bytes / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free; make room")


def unpack(archive: IO[bytes], contents: Contents, scratch: Path, where: str) -> None:
    """Write each file that follows the manifest into `scratch`, named by its digest, which is checked."""
    missing = contents.sizes_bytes()
    for digest, size_bytes in _members(archive, where):
        if missing.pop(digest, -1) != size_bytes:
            raise InputError(f"{where}: holds {digest!r}, which its manifest does not name; export it again")
        seen = hashlib.sha256()
        with (scratch / digest).open("xb") as file:
            for start in range(0, size_bytes, CHUNK_BYTES):
                chunk = archive.read(min(CHUNK_BYTES, size_bytes - start))
                seen.update(chunk)
                file.write(chunk)
        archive.seek(-size_bytes % BLOCK, os.SEEK_CUR)
        if seen.hexdigest() != digest:
            raise InputError(f"{where}: is damaged or cut short; copy it again")
    if missing:
        raise InputError(f"{where}: {len(missing)} files are missing at its end; copy it again")


def place(store: Store, name: str, one: ArchivedArtifact, scratch: Path) -> Artifact:
    """Move an artifact's files from `scratch` into the store and record it; the lock of its key must be held."""
    stage, key = name.split("/")
    partial = store.path(stage, key, ".partial")
    remove(partial)
    partial.mkdir()
    for inside, file in one.files.items():
        (partial / inside).parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(scratch / file.sha256, partial / inside)
        except OSError:  # the stage's folder is on another disk, or this one knows no second name of a file
            shutil.copyfile(scratch / file.sha256, partial / inside)
    described = one.model_dump(include={"metrics", "inputs"})
    return store.commit(Artifact(stage=stage, root=store.path(stage, key), files={}, **described))


def _add(archive: tarfile.TarFile, name: str, size_bytes: int, content: IO[bytes]) -> None:
    member = tarfile.TarInfo(name)
    member.size = size_bytes
    archive.addfile(member, content)


def _members(archive: IO[bytes], where: str) -> Iterator[tuple[str, int]]:
    """Yield the name and the size of each member. Its content must be read, up to the next block, before the next one
    is requested.

    Only plain files are accepted as members: no links, devices or folders, nor headers of variable size, which a
    general reader would load into memory.
    """
    while block := archive.read(BLOCK):
        if not any(block):
            return
        try:
            member = tarfile.TarInfo.frombuf(block, "ascii", "strict")
        except (tarfile.HeaderError, UnicodeError, ValueError):
            raise InputError(f"{where}: is not an archive of `hnerf store export`, or damaged") from None
        if member.type != tarfile.REGTYPE or member.size < 0:
            raise InputError(f"{where}: {member.name!r} is not a plain file; give an archive of `hnerf store export`")
        yield member.name, member.size

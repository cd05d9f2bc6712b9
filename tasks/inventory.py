"""The contents of a store: its artifacts, the subjects they belong to, and what they were computed from."""

import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from hnerf.capture.safe_io import read_json
from hnerf.errors import InputError
from tasks.pins import pinned
from tasks.store import STAGES, Artifact, Store

KEY = re.compile(r"[0-9a-f]{32}")
STAGE = re.compile(r"[a-z][a-z-]*")
NO_STAGES = ("subjects", "ingested")
NOBODY = "-"


@dataclass(frozen=True)
class Stored:
    """An artifact, and when it was made and last used, in seconds since 1970."""

    artifact: Artifact
    made_s: float
    used_s: float

    @property
    def size_bytes(self) -> int:
        """Return the size of its files."""
        return sum(file.size_bytes for file in self.artifact.files.values())


@dataclass(frozen=True)
class Inventory:
    """The artifacts of a store by name (`<stage>/<key>`), each subject's latest artifacts by stage, and the records
    that cannot be read or have no folder."""

    store: Store
    stored: dict[str, Stored]
    latest: dict[str, dict[str, str]]
    unreadable: tuple[Path, ...]

    @staticmethod
    def of(store: Store) -> "Inventory":
        """Read the records and links of a store; flows may run meanwhile."""
        stored, unreadable = {}, []
        for record in in_stages(store, "*.json"):
            if not KEY.fullmatch(record.stem) or not record.is_file():
                continue
            try:
                artifact = store.recorded(record.parent.name, record.stem)
                times = artifact and Stored(artifact, artifact.root.stat().st_mtime, record.stat().st_mtime)
            except (FileNotFoundError, NotADirectoryError):
                times = None
            if times:
                stored[times.artifact.name] = times
            elif record.exists():
                unreadable.append(record)
        return Inventory(store, stored, _latest(store), tuple(unreadable))

    def with_inputs(self, names: Iterable[str]) -> set[str]:
        """Return these artifacts and all that they were computed from, as far as these exist and the records name
        them."""
        found: set[str] = set()
        waiting = list(names)
        while waiting:
            name = waiting.pop()
            if name in self.stored and name not in found:
                found.add(name)
                waiting += self.stored[name].artifact.inputs
        return found

    @cached_property
    def owners(self) -> dict[str, set[str]]:
        """Return the subjects of each artifact: those that link to it or to something computed from it, or else those
        whose recordings it was computed from."""
        owners: dict[str, set[str]] = {name: set() for name in self.stored}
        for subject, links in self.latest.items():
            for name in self.with_inputs(links.values()):
                owners[name].add(subject)
        recorded = {name: _recorded_name(one.artifact) for name, one in self.stored.items()}
        for name in [name for name, subjects in owners.items() if not subjects]:
            owners[name] = {recorded[one] for one in self.with_inputs([name])} - {""}
        return owners

    def of_subject(self, subject: str) -> list[Stored]:
        """Return a subject's artifacts, in the order in which they were made."""
        mine = [self.stored[name] for name, subjects in self.owners.items() if subject in subjects]
        return sorted(mine, key=lambda one: one.made_s)

    @property
    def used(self) -> set[str]:
        """Return the names of the artifacts that subjects link to or running processes use, whether they exist or
        not."""
        return pinned(self.store.root).union(*(links.values() for links in self.latest.values()))

    def needed(self, keep: int = 1) -> set[str]:
        """Return the artifacts that are needed by the `keep` newest results of every subject, by its links, and by
        running processes."""
        roots = self.used
        for subject, links in self.latest.items():
            ended_early = "asset" not in links  # an unfinished run replaced the links of a finished one
            newest = [one.artifact for one in self.of_subject(subject)[::-1]] if keep > 1 or ended_early else []
            assets = [one for one in newest if one.stage == "asset"][:keep]  # only a complete run ends with one
            trained = {name for one in assets for name in one.inputs if name.startswith("training/")}
            scores = [one for one in newest if one.stage == "evaluation" and trained & set(one.inputs)]
            roots |= {one.name for one in assets + scores}
        return self.with_inputs(roots)


def in_stages(store: Store, pattern: str) -> Iterator[Path]:
    """Yield the files and folders in the folders of stages, and nothing else in the store."""
    for folder in sorted(store.root.iterdir()):
        if STAGE.fullmatch(folder.name) and folder.name not in NO_STAGES:
            yield from sorted(folder.glob(pattern))


def _latest(store: Store) -> dict[str, dict[str, str]]:
    """Return the names of the artifacts to which each subject's links point."""
    folders = sorted(path for path in (store.root / "subjects").glob("*") if path.is_dir())
    return {
        folder.name: {s: f"{s}/{Path(os.readlink(folder / s)).name}" for s in STAGES if (folder / s).is_symlink()}
        for folder in folders
    }


def _recorded_name(artifact: Artifact) -> str:
    """Return the name of the person in a recording; empty for artifacts of other stages."""
    if artifact.stage != "capture":
        return ""
    described = artifact.root / "capture.json"
    try:
        return "" if described.is_symlink() else str(read_json(described)["name"])
    except (InputError, LookupError, TypeError):  # damaged, or no file
        return ""

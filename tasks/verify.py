"""Check of whether a store holds what its records say."""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from hnerf.errors import InputError
from tasks.inventory import Inventory
from tasks.store import Artifact, Store


@dataclass(frozen=True)
class Checked:
    """What was checked, and one line per fault."""

    artifacts: int
    files: int
    size_bytes: int
    lines: list[str]


def faults(store: Store, subjects: Iterable[str] = ()) -> Checked:
    """Check the digests of all artifacts, or of those of some subjects, that there are no unrecorded files next to the
    recorded ones, and that links lead somewhere. Unfinished work is not checked. Raises InputError for an unknown
    subject."""
    inventory = Inventory.of(store)
    chosen = list(inventory.stored.values())
    links = inventory.latest
    if wanted := list(subjects):
        for subject in wanted:
            if not inventory.of_subject(subject):
                raise InputError(f"{subject}: no such subject in {store.root}; `hnerf store list` names them")
        links = {subject: inventory.latest.get(subject, {}) for subject in wanted}
        names = {one.artifact.name for subject in wanted for one in inventory.of_subject(subject)}
        chosen = [inventory.stored[name] for name in sorted(names)]
    lines = [] if wanted else [f"{record}: {_why_unreadable(record)}" for record in inventory.unreadable]
    for subject, latest in links.items():
        lost = [stage for stage, name in latest.items() if name not in inventory.stored]
        lines += [f"{store.subject_folder(subject) / stage}: leads nowhere" for stage in lost]
    for one in chosen:
        lines += _faults(one.artifact)
    count = sum(len(one.artifact.files) for one in chosen)
    return Checked(len(chosen), count, sum(one.size_bytes for one in chosen), lines)


def _why_unreadable(record: Path) -> str:
    return "the record cannot be read" if record.with_suffix("").is_dir() else "its folder is missing"


def _faults(artifact: Artifact) -> Iterator[str]:
    damaged = artifact.damaged_file()
    if damaged and artifact.root.with_name(f"{artifact.root.name}.json").exists():  # and was not just removed
        yield f"{damaged}: damaged or missing"
    for parent, folders, files in os.walk(artifact.root):
        for name in files + [folder for folder in folders if (Path(parent) / folder).is_symlink()]:
            path = Path(parent) / name
            if str(path.relative_to(artifact.root)) not in artifact.files:
                yield f"{path}: not of this artifact"

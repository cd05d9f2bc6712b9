"""A subject as one file: the artifacts of its latest results, packed (tasks/packed.py), and its links."""

from collections.abc import Collection
from pathlib import Path
from typing import Annotated
from uuid import uuid4

from pydantic import Field, model_validator

from hnerf.config import validated
from hnerf.errors import InputError
from hnerf.files import atomic_file, made_folder
from tasks.inventory import Inventory
from tasks.packed import Contents, Name, archived, pack, place, read_contents, require_room, unpack
from tasks.store import OPTIONAL, STAGES, Store


class Manifest(Contents):
    """The contents of a subject's archive. recording: the lines of the subject's `.recording`; latest: the artifact of
    each stage."""

    subject: Annotated[str, Field(pattern=r"^[^/]{1,200}$")]
    recording: Annotated[str, Field(pattern=r"^([0-9a-f]{64}\n[^\n]*\n)?$")]
    latest: dict[str, Name]

    @model_validator(mode="after")
    def _links_lead_to_what_is_here(self) -> "Manifest":
        if self.subject in (".", "..") or not self.subject.isprintable():
            raise ValueError(f"{self.subject!r} cannot be the name of a folder")
        for stage, name in self.latest.items():
            if stage not in STAGES or name not in self.artifacts or name.partition("/")[0] != stage:
                raise ValueError(f"latest: {stage}: no such artifact")
        return self


def export_subject(store: Store, subject: str, out: Path) -> Manifest:
    """Write a subject's latest artifacts, with all artifacts that they were computed from, into a new file. Raises
    InputError if there is no such subject, an artifact is damaged or missing, or `out` exists."""
    if out.exists():
        raise InputError(f"{out}: exists; give the name of a new file")
    inventory = Inventory.of(store)
    latest = inventory.latest.get(subject, {})
    if not latest:
        raise InputError(f"{store.subject_folder(subject)}: no results; `hnerf store list` names the subjects")
    artifacts = [store.intact(*name.split("/")) for name in sorted(_needed(inventory, latest.values()))]
    described = {"subject": subject, "recording": store.recording(subject), "latest": latest}
    manifest = validated(Manifest, {**described, "artifacts": archived(artifacts)}, store.subject_folder(subject))
    with made_folder(out.parent), atomic_file(out) as beside:
        pack(manifest, store, beside)
    return manifest


def import_subject(store: Store, path: Path) -> Manifest:
    """Put an archive's artifacts into the store, as if they had been computed there, and link the subject to them.

    Artifacts that the store already has stay. Raises InputError, and links nothing, if the file is not such an archive,
    is damaged or would fill the disk, or if the subject's name belongs to another recording in this store.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; give an archive of `hnerf store export`")
    with path.open("rb") as archive, store.scratch("capture", uuid4().hex) as scratch:
        manifest = read_contents(Manifest, archive, str(path))
        require_room(manifest.unpacked_bytes(), store.root, str(path))
        _check_subject(manifest, store)
        unpack(archive, manifest, scratch, str(path))
        for name, one in manifest.artifacts.items():
            stage, key = name.split("/")
            with store.locked(stage, key):
                if not store.find(stage, key):
                    place(store, name, one, scratch)
        if manifest.recording:
            digest, _, folder = manifest.recording.strip().partition("\n")
            store.claim(manifest.subject, digest, folder)
        store.unlink_latest(manifest.subject, OPTIONAL - manifest.latest.keys())
        for stage in sorted(manifest.latest, key=STAGES.index):
            store.link_latest(manifest.subject, store.intact(*manifest.latest[stage].split("/")))
    return manifest


def _needed(inventory: Inventory, latest: Collection[str]) -> set[str]:
    """Return these artifacts and all that they were computed from, damaged ones, too. Without inputs that were never in
    this store: what came from a bucket may have been computed from equal ones under other keys."""
    stored = inventory.with_inputs(latest)
    inputs = {name for one in stored for name in inventory.stored[one].artifact.inputs}
    paths = {name: inventory.store.path(*name.split("/")) for name in inputs - stored}
    left = {name for name, path in paths.items() if path.exists() or path.with_suffix(".json").exists()}
    return {*latest, *stored, *left}


def _check_subject(manifest: Manifest, store: Store) -> None:
    """Raise InputError if the subject's name belongs to another recording."""
    here = store.subject_folder(manifest.subject)
    if here.is_dir() and any(here.iterdir()):
        recording = store.recording(manifest.subject)
        if recording.partition("\n")[0] != manifest.recording.partition("\n")[0] or not recording:
            raise InputError(f"{here}: has the results of another recording; import into another store")

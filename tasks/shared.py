"""Artifacts that the stores of many machines share through a bucket.

    <bucket>/<stage>/<key>.tar    an artifact as one file (tasks/packed.py)

A store takes from the bucket what it lacks, and puts there what it has made. Whoever can write into the bucket can
determine results; but nothing in it is executed, and nothing in it leads out of the store.
"""

import logging
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

from hnerf.errors import InputError, PlaceError
from tasks.bucket import Bucket
from tasks.lease import leased
from tasks.packed import Contents, archived, pack, place, read_contents, require_room, unpack
from tasks.shared_checkpoint import shared_checkpoint
from tasks.store import Artifact, Store

log = logging.getLogger("hnerf.shared")

PACKED = "packed"


def get_or_compute(
    bucket: Bucket, store: Store, stage: str, key: str, compute: Callable[[], Artifact], checkpoint: str = ""
) -> Artifact:
    """Return the artifact from the store, else from the bucket, else compute it with `compute`, which puts it into the
    store. Afterwards it is in both.

    If several machines want the same artifact, one computes it and the others wait. If that one is lost, another
    continues from its checkpoint. checkpoint: the name of that file in the folder of unfinished work. Raises
    BucketError if the bucket cannot be reached.
    """
    name = f"{stage}/{key}"
    if here := store.find(stage, key):
        return _put_if_missing(bucket, store, here)
    while (found := _fetch(bucket, store, stage, key)) is None:
        with leased(bucket, name) as mine:
            if mine:
                if found := _fetch(bucket, store, stage, key):  # another may have finished just before
                    return _put_if_missing(bucket, store, found)
                with shared_checkpoint(bucket, store, stage, key, checkpoint) if checkpoint else nullcontext():
                    made = compute()
                    _put(bucket, store, made)
                return made
    return found


def _fetch(bucket: Bucket, store: Store, stage: str, key: str) -> Artifact | None:
    """Put the bucket's artifact into the store, unless the store has it. Return None if it is missing or damaged."""
    name = f"{stage}/{key}"
    where = bucket.where(_object(name))
    with store.scratch(stage, key) as scratch:
        if found := store.find(stage, key):
            return found
        if (size_bytes := bucket.size_bytes(_object(name))) is None:
            return None
        log.info("fetching %s (%.1f MB)", name, size_bytes / 1e6)
        require_room(size_bytes, scratch, where)
        try:
            bucket.download(_object(name), scratch / PACKED)
        except FileNotFoundError:  # removed meanwhile
            return None
        try:
            contents = _unpacked(scratch, name, where)
        except PlaceError:  # the disk is full
            raise
        except InputError as error:
            log.warning("%s (%s is computed again)", error, stage)
            return None
        place(store, name, contents.artifacts[name], scratch)
        store.path(stage, key, ".shared").unlink(missing_ok=True)  # it belonged to work that another machine finished
    return store.find(stage, key)


def _unpacked(scratch: Path, name: str, where: str) -> Contents:
    """Unpack an object that holds the artifact of this name. Raises InputError if it is damaged."""
    with (scratch / PACKED).open("rb") as archive:
        contents = read_contents(Contents, archive, where)
        if list(contents.artifacts) != [name]:
            raise InputError(f"{where}: holds something else; remove it")
        require_room(contents.unpacked_bytes(), scratch, where)
        unpack(archive, contents, scratch, where)
    return contents


def _put_if_missing(bucket: Bucket, store: Store, artifact: Artifact) -> Artifact:
    """Put an artifact of the store into the bucket unless the bucket has it; return the artifact."""
    if bucket.size_bytes(_object(artifact.name)) is None:
        _put(bucket, store, artifact)
    return artifact


def _put(bucket: Bucket, store: Store, artifact: Artifact) -> None:
    """Put an artifact of the store into the bucket."""
    log.info("sharing %s", artifact.name)
    with store.scratch(artifact.stage, artifact.root.name) as scratch:
        pack(Contents(artifacts=archived([artifact])), store, scratch / PACKED)
        bucket.upload(scratch / PACKED, _object(artifact.name))


def _object(name: str) -> str:
    return f"{name}.tar"

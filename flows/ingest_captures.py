"""Watch a folder, and train once whatever appears in it."""

import hashlib
import logging
import os
import time
from pathlib import Path
from uuid import uuid4

from prefect import flow
from prefect.deployments import run_deployment

from hnerf.errors import InputError
from hnerf.files import replace_text
from tasks.source import capture_files, read_capture

DEPLOYMENT = "train-subject/local"

log = logging.getLogger("hnerf.ingest_captures")


@flow(name="ingest-captures")
def ingest_captures(
    folder: Path, preset: str = "fast", store: Path = Path("store"), settle_s: float = 60.0
) -> list[str]:
    """Start `train-subject` once for every capture in the subfolders of `folder`; returns those started now.

    `folder` is made if it is not there. A capture is known by its content: moved, renamed or copied, it is not trained
    again. One that was touched less than `settle_s` seconds ago is still being written and waits for the next look, and
    so does one that cannot be read, which is logged.
    `<store>/ingested/<digest>` records where each was found and the flow run that trains it.
    """
    ledger = store.resolve() / "ingested"
    ledger.mkdir(parents=True, exist_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    started = []
    for capture in sorted(path for path in folder.resolve().iterdir() if path.is_dir() and path.name[0] != "."):
        try:
            files = capture_files(capture)
            glimpse = _glimpse(files)
            if not files or _age_s(files) < settle_s or (ledger / glimpse).exists():
                continue
            digest = read_capture(capture)[0].digest
        except (InputError, OSError) as error:  # OSError: a file that is gone by now
            log.error("%s", error)
            continue
        if not (ledger / digest).exists():
            parameters = {"capture": str(capture), "preset": preset, "store": str(store.resolve())}
            key = f"{_own_id(ledger)} {digest}"
            run = run_deployment(DEPLOYMENT, parameters=parameters, timeout=0, as_subflow=False, idempotency_key=key)
            (ledger / digest).write_text(f"{capture}\n{run.id}\n")  # type: ignore[union-attr]
            log.info("started %s for %s", DEPLOYMENT, capture)
            started.append(capture.name)
        (ledger / glimpse).touch()
    return started


def _own_id(ledger: Path) -> str:
    """A ledger's random id: Prefect gives back the finished run of a key it knows, even where the store is another."""
    path = ledger / "id"
    if not path.exists():
        replace_text(path, uuid4().hex)
    return path.read_text()


def _age_s(files: list[Path]) -> float:
    """Seconds since a file was last written, moved or made; modification times alone may be those of the original."""
    return time.time() - max(path.lstat().st_ctime for path in files)


def _glimpse(files: list[Path]) -> str:
    """Digest of names, sizes and times: tells without reading a byte that a folder was looked at before."""
    listing = hashlib.sha256()
    for path in files:
        stat = path.lstat()
        listing.update(os.fsencode(f"{path} {stat.st_size} {stat.st_mtime_ns}\n"))
    return f"seen-{listing.hexdigest()}"

"""Watch a folder, and train every capture that appears in it once."""

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
    """Start `train-subject` once for every capture in the subfolders of `folder`; return those started now.

    `folder` is made if it does not exist. A capture is known by its content: moved, renamed or copied, it is not
    trained again. One that was touched less than `settle_s` seconds ago is still being written and waits for the next
    call, and so does one that cannot be read, which is logged. `<store>/ingested/<digest>` records where each was found
    and the flow run that trains it.
    """
    ledger = store.resolve() / "ingested"
    ledger.mkdir(parents=True, exist_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    started = []
    for capture in sorted(path for path in folder.resolve().iterdir() if path.is_dir() and path.name[0] != "."):
        try:
            files = capture_files(capture)
            listing_digest = _listing_digest(files)
            if not files or _age_s(files) < settle_s or (ledger / listing_digest).exists():
                continue
            digest = read_capture(capture)[0].digest
        except (InputError, OSError) as error:  # OSError: a file was removed meanwhile
            log.error("%s", error)
            continue
        if not (ledger / digest).exists():
            parameters = {"capture": str(capture), "preset": preset, "store": str(store.resolve())}
            key = f"{_ledger_id(ledger)} {digest}"
            run = run_deployment(DEPLOYMENT, parameters=parameters, timeout=0, as_subflow=False, idempotency_key=key)
            (ledger / digest).write_text(f"{capture}\n{run.id}\n")  # type: ignore[union-attr]
            log.info("started %s for %s", DEPLOYMENT, capture)
            started.append(capture.name)
        (ledger / listing_digest).touch()
    return started


def _ledger_id(ledger: Path) -> str:
    """Return a ledger's random id. Without it, Prefect would return the finished run of a known key even for another
    store."""
    path = ledger / "id"
    if not path.exists():
        replace_text(path, uuid4().hex)
    return path.read_text()


def _age_s(files: list[Path]) -> float:
    """Return the seconds since a file was last written, moved or made; modification times alone may be those of the
    original."""
    return time.time() - max(path.lstat().st_ctime for path in files)


def _listing_digest(files: list[Path]) -> str:
    """Return a digest of names, sizes and times, which tells whether a folder was seen before without reading its
    files."""
    listing = hashlib.sha256()
    for path in files:
        stat = path.lstat()
        listing.update(os.fsencode(f"{path} {stat.st_size} {stat.st_mtime_ns}\n"))
    return f"seen-{listing.hexdigest()}"

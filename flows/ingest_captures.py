"""Watch a folder, and train every capture that appears in it once."""

import hashlib
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path

from prefect import flow, get_client
from prefect.client.schemas.filters import (
    DeploymentFilter,
    DeploymentFilterName,
    FlowFilter,
    FlowFilterName,
    FlowRunFilter,
    FlowRunFilterState,
    FlowRunFilterStateType,
)
from prefect.client.schemas.objects import StateType
from prefect.deployments import run_deployment

from hnerf.errors import InputError
from tasks.ledger import Ledger
from tasks.source import capture_files, read_capture

FLOW, NAME = "train-subject", "local"
DEPLOYMENT = f"{FLOW}/{NAME}"
UNFINISHED = (StateType.SCHEDULED, StateType.PENDING, StateType.RUNNING, StateType.PAUSED, StateType.CANCELLING)

log = logging.getLogger("hnerf.ingest_captures")


@flow(name="ingest-captures")
def ingest_captures(
    folder: Path, preset: str = "fast", store: Path = Path("store"), settle_s: float = 60.0, max_unfinished: int = 20
) -> list[str]:
    """Start `train-subject` once for every capture in the subfolders of `folder`; return those started now.

    `folder` is made if it does not exist. A capture is known by its content: moved, renamed or copied, it is not
    trained again, unless its run found the folder missing. One that was touched less than `settle_s` seconds ago is
    still being written and waits for the next call, and so does one that cannot be read, which is logged. Nothing more
    is started while `max_unfinished` runs have not ended: workers ask for all that wait again and again.
    """
    ledger = Ledger.of(store)
    folder.mkdir(parents=True, exist_ok=True)
    started: list[str] = []
    room = max_unfinished
    for capture in _captures(folder.resolve()):
        try:
            files = capture_files(capture)
            listing = _listing_digest(files)
            if not files or _age_s(files) < settle_s or ledger.seen(listing):
                continue
            digest = read_capture(capture)[0].digest
        except (InputError, OSError) as error:  # OSError: a file was removed meanwhile
            log.error("%s", error)
            continue
        if not ledger.knows(digest):
            room = room if started else max_unfinished - unfinished_runs()
            if len(started) >= room:
                log.info("%s and what follows wait: %d runs have not ended", capture, max_unfinished)
                break
            parameters = {"capture": str(capture), "preset": preset, "store": str(store.resolve())}
            key = ledger.start_key(digest)
            run = run_deployment(DEPLOYMENT, parameters=parameters, timeout=0, as_subflow=False, idempotency_key=key)
            ledger.note_started(digest, capture, run.id)  # type: ignore[union-attr]
            log.info("started %s for %s", DEPLOYMENT, capture)
            started.append(capture.name)
        ledger.note_seen(listing, digest)
    return started


def unfinished_runs() -> int:
    """Return how many runs of the deployment have not ended."""
    with get_client(sync_client=True) as client:
        found = client.read_flow_runs(
            flow_filter=FlowFilter(name=FlowFilterName(any_=[FLOW])),
            deployment_filter=DeploymentFilter(name=DeploymentFilterName(any_=[NAME])),
            flow_run_filter=FlowRunFilter(state=FlowRunFilterState(type=FlowRunFilterStateType(any_=list(UNFINISHED)))),
        )
    return len(found)


def _captures(folder: Path) -> Iterator[Path]:
    """Yield the subfolders, sorted, without hidden ones and links, which may lead anywhere."""
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or not path.is_dir():
            continue
        if path.is_symlink():
            log.warning("%s: is a symbolic link and not followed; move the folder itself here", path)
            continue
        yield path


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

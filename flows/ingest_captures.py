"""Watch a folder, and train once on every capture that appears in it."""

import hashlib
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from prefect import flow
from prefect.context import FlowRunContext
from prefect.deployments import run_deployment
from prefect.events import emit_event
from pydantic import Field

from flows.arguments import StoreFolder
from flows.restart import DEPLOYMENT, restart_crashed, unfinished_runs
from hnerf.config import load_settings, require_named_files
from hnerf.errors import InputError, printable
from hnerf.files import now_s
from tasks import quarantine
from tasks.bucket import Bucket, is_visible
from tasks.ledger import Ledger
from tasks.remote import remote_captures
from tasks.source import entries, path_or_url, read_capture

DISK_EVENT = "hnerf.disk.nearly-full"  # flows/automations.py notifies the operator

log = logging.getLogger("hnerf.ingest_captures")


@flow(name="ingest-captures")
def ingest_captures(
    folder: Path | str,
    preset: str = "fast",
    store: StoreFolder = Path("store"),
    settle_s: Annotated[float, Field(ge=0, le=86400)] = 60.0,
    max_unfinished: Annotated[int, Field(ge=1, le=1000)] = 20,
    max_restarts: Annotated[int, Field(ge=0, le=20)] = 3,
    min_free_gib: Annotated[float, Field(ge=0)] = 10.0,
) -> list[str]:
    """Start `train-subject` once for every capture in the subfolders of a folder; return those started now.

    The folder is created if it does not exist. A capture is identified by its content: moved, renamed or copied, it is
    not trained again, unless its run found the folder missing, or failed through its machine's fault. In a bucket,
    names, sizes and ETags identify it. `<folder>/.refused/<name>.txt` says why a capture cannot be read (not in a
    bucket). Crashed runs are queued again.

    Args:
        folder: The folder to watch, or the URL of one in a bucket. Each subfolder is a capture.
        preset: Settings of the runs: a preset of configs/, or a YAML file.
        store: Folder of results.
        settle_s: A folder that changed less than this many seconds ago counts as still being written. For a bucket, set
            more than the upload of the largest file takes.
        max_unfinished: Start nothing while this many runs are waiting or running.
        max_restarts: How often to restart a run whose process or machine was lost, before it fails.
        min_free_gib: Start nothing while the store's disk has less free space than this, in GiB.
    """
    ledger = Ledger.of(store)
    ledger.sweep()
    folder = path_or_url(folder)
    if isinstance(folder, Path):
        folder.mkdir(parents=True, exist_ok=True)
        quarantine.clear_removed(folder)
    if not _has_room(store, min_free_gib):
        return []
    for lost, why in restart_crashed(max_restarts):
        capture = path_or_url(lost.parameters["capture"])
        quarantine.note_run(capture, store, f"failed: {why} (flow run {lost.name}, {lost.id})")
    # A misspelled name would use up every capture: failed runs are not started again.
    require_named_files(load_settings(preset))
    Bucket.configured()  # likewise a bucket that is not there
    started: list[str] = []
    room: int | None = None
    for capture, listing in _unseen(folder, ledger, settle_s):
        room = max_unfinished - unfinished_runs() if room is None else room
        if len(started) >= room:  # before the capture is read, or every look would read it again
            log.info("%s and what follows wait: %d runs have not ended", printable(str(capture)), max_unfinished)
            break
        digest = _digest(capture, listing, ledger)
        if digest is None:
            continue
        if not ledger.knows(digest):
            parameters = {"capture": str(capture), "preset": preset, "store": str(store.absolute())}
            key = ledger.start_key(digest)
            run = run_deployment(DEPLOYMENT, parameters=parameters, timeout=0, as_subflow=False, idempotency_key=key)
            ledger.note_started(digest, capture, run.id)  # type: ignore[union-attr]
            log.info("started %s for %s", DEPLOYMENT, printable(str(capture)))
            quarantine.clear(capture)
            started.append(Path(capture).name)
        ledger.note_seen(listing, digest)
    return started


def _has_room(store: Path, min_free_gib: float) -> bool:
    """Return whether the store's disk has enough free space; if not, log it and notify the server."""
    free_gib = shutil.disk_usage(store).free / 2**30
    if free_gib >= min_free_gib:
        return True
    log.warning("%s: %.1f GiB are free, less than %g: nothing is started; see `hnerf store gc`", store.resolve(),
                free_gib, min_free_gib)  # fmt: skip
    if FlowRunContext.get():
        resource = {"prefect.resource.id": f"hnerf.store.{store.resolve()}", "prefect.resource.name": str(store)}
        emit_event(DISK_EVENT, resource=resource, payload={"free_gib": round(free_gib, 1)})
    return False


def _unseen(folder: Path | str, ledger: Ledger, settle_s: float) -> Iterator[tuple[Path | str, str]]:
    """Yield the captures of a folder that are complete and were not seen before, with the digests of their listings.
    For a capture that cannot be read, note why (not in a bucket)."""
    if isinstance(folder, str):
        for remote in remote_captures(folder):
            listing = f"seen-{remote.digest}"
            if not ledger.seen(listing) and ledger.stood_s(listing) >= settle_s:
                yield remote.url, listing
        return
    for capture in _captures(folder.absolute()):  # elsewhere, a link may lead to another place
        try:
            listing, touched_s = _listing(capture)
            if touched_s and not ledger.seen(listing) and now_s(folder) - touched_s >= settle_s:
                yield capture, listing
        except FileNotFoundError as error:  # removed meanwhile
            log.error("%s", error)
        except (InputError, OSError) as error:
            _refuse(capture, error)


def _digest(capture: Path | str, listing: str, ledger: Ledger) -> str | None:
    """Return the digest of a capture's content; in a bucket, the listing takes its place. Return None, and note why, if
    the capture cannot be read, or could not be read a short time ago."""
    if isinstance(capture, str):
        return listing.removeprefix("seen-")
    if why := ledger.refused(listing):
        _refuse(capture, InputError(why))
        return None
    try:
        return read_capture(capture)[0].digest
    except (InputError, OSError) as error:
        ledger.note_refused(listing, printable(str(error)))
        _refuse(capture, error)
        return None


def _refuse(capture: Path, error: Exception) -> None:
    """Note why a capture cannot be read."""
    log.error("%s", error)
    with suppress(OSError):  # a read-only folder
        quarantine.note(capture, f"refused: {error}")


def _captures(folder: Path) -> Iterator[Path]:
    """Yield the subfolders, sorted, without hidden ones and without links, which may lead anywhere."""
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or not path.is_dir():
            continue
        if path.is_symlink():
            # The server takes no log with a name that is not UTF-8.
            log.warning("%s: is a symbolic link and not followed; move the folder itself here", printable(str(path)))
            continue
        yield path


def _listing(capture: Path) -> tuple[str, float]:
    """Return a digest of the names, sizes and times of a folder's files, and when one was last written, moved or
    created (0 if there is none). The digest tells whether the folder was seen before without reading the files. Change
    times are among its times, since a copy may keep the original's modification time. A hidden file, such as a copy in
    progress, counts only for the time."""
    listing, touched_s, files = hashlib.sha256(), 0.0, 0
    for entry in sorted(entries(capture, hidden=True), key=lambda entry: entry.path):
        stat = entry.stat(follow_symlinks=False)
        touched_s = max(touched_s, stat.st_ctime)
        if is_visible(entry.path.removeprefix(f"{capture}/")):
            listing.update(os.fsencode(f"{entry.path} {stat.st_size} {stat.st_mtime_ns} {stat.st_ctime_ns}\n"))
            files += 1
    return f"seen-{listing.hexdigest()}", touched_s if files else 0.0

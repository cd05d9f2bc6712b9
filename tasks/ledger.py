"""The ledger of a watched folder: which captures were started, by their content.

<store>/ingested/<digest>         the folder and the flow run of a capture that was started
<store>/ingested/<digest>.lost    the same, if the run did not find its folder or its machine failed: it may start again
<store>/ingested/<digest>.failed  the flow runs after which the capture was released because their machine failed
<store>/ingested/seen-<listing>   the digest of a folder with these names, sizes and times, which need not be read
<store>/ingested/new-<listing>    a listing in a bucket that is not started yet; written when it was first seen
<store>/ingested/refused-<listing>  why a folder with this listing cannot be read
<store>/ingested/id               random, so that the same key in another ledger is another run
"""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

from hnerf.files import now_s, replace_text

LOST, FAILED = ".lost", ".failed"
RETRY_S = 3600  # after which a folder that could not be read is read again, although its listing is the same
STALE_S = 2 * 86400  # a listing waits for at most a day (`settle_s`)
RELEASES = 3  # of a capture; the fault may be in every machine, or not in the machine after all


@dataclass(frozen=True)
class Ledger:
    """The ledger of one store."""

    root: Path

    @staticmethod
    def of(store: Path) -> "Ledger":
        """Return a store's ledger; create it if there is none."""
        root = store.resolve() / "ingested"
        root.mkdir(parents=True, exist_ok=True)
        return Ledger(root)

    def knows(self, digest: str) -> bool:
        """Return whether a capture was started and has not been lost since."""
        return (self.root / digest).exists()

    def seen(self, listing: str) -> bool:
        """Return whether a folder with this listing was read before and its capture was started."""
        path = self.root / listing
        return path.exists() and self.knows(path.read_text(errors="replace").strip() or "none")

    def stood_s(self, listing: str) -> float:
        """Return for how long a listing has been the same, in seconds: 0 on the first call for it."""
        path = self.root / f"new-{listing}"
        if not path.exists():
            replace_text(path, "")
        return now_s(self.root) - path.stat().st_mtime

    def sweep(self) -> None:
        """Remove notes about listings that nobody asked for lately: their folders have changed since."""
        stale_s = now_s(self.root) - STALE_S
        for path in (*self.root.glob("new-*"), *self.root.glob("refused-*")):
            with suppress(FileNotFoundError):  # another machine's scan may have removed it
                if path.stat().st_mtime < stale_s:
                    path.unlink()

    def note_seen(self, listing: str, digest: str) -> None:
        """Note the content of a folder with this listing."""
        replace_text(self.root / listing, digest)
        (self.root / f"new-{listing}").unlink(missing_ok=True)

    def note_refused(self, listing: str, why: str) -> None:
        """Note why a folder with this listing cannot be read."""
        replace_text(self.root / f"refused-{listing}", why)

    def refused(self, listing: str) -> str:
        """Return why a folder with this listing could not be read; empty if it is time to try again: the reason may be
        a disk or a right of access that has been mended since."""
        path = self.root / f"refused-{listing}"
        fresh = path.exists() and now_s(self.root) - path.stat().st_mtime < RETRY_S
        return path.read_text(errors="replace") if fresh else ""

    def note_started(self, digest: str, capture: Path | str, run: object) -> None:
        """Note that a capture was started."""
        replace_text(self.root / digest, f"{capture}\n{run}\n")
        (self.root / f"{digest}{LOST}").unlink(missing_ok=True)

    def start_key(self, digest: str) -> str:
        """Return the idempotency key of a capture's run. It stays the same until the start is noted, and changes after
        a run was lost and in another ledger, because Prefect returns the finished run of a key that it knows."""
        identity, lost = self.root / "id", self.root / f"{digest}{LOST}"
        if not identity.exists():
            replace_text(identity, uuid4().hex)
        lines = lost.read_text(errors="replace").splitlines() if lost.exists() else []
        return " ".join([identity.read_text(), digest, *lines[-1:]])  # the last line names the run


def forget(store: Path, capture: Path | str) -> None:
    """Release the capture that was started from a folder or URL where it no longer is, so that the next look starts it
    from where it is now."""
    for record, _ in started_from(store, capture):
        _forget(record)


def release(store: Path, capture: Path | str, failed_run: str) -> None:
    """Release the capture that a run was started for, which failed through no fault of the capture, so that the next
    look starts it again, at most RELEASES times."""
    for record, run in started_from(store, capture):
        failed = record.with_name(f"{record.name}{FAILED}")
        runs = failed.read_text(errors="replace").splitlines() if failed.exists() else []
        if run == failed_run and len(runs) < RELEASES:
            _forget(record)
            replace_text(failed, "\n".join([*runs, run, ""]))


def started_from(store: Path, capture: Path | str) -> list[tuple[Path, str]]:
    """Return the records of what was started from a folder or URL, and the flow runs in them."""
    started = capture if isinstance(capture, str) else str(capture.absolute())
    records = [(record, record.read_text(errors="replace")) for record in (store / "ingested").glob("[0-9a-f]" * 64)]
    return [(record, text.partition("\n")[2].strip()) for record, text in records if text.partition("\n")[0] == started]


def _forget(record: Path) -> None:
    record.rename(record.with_name(f"{record.name}{LOST}"))  # needs no space on a full disk

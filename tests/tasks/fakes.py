"""Fake stages, which record their calls in the file `calls` in the store."""

from pathlib import Path

from hnerf.config import CaptureSettings
from hnerf.errors import InputError
from tasks.source import Source
from tasks.stage import stage
from tasks.store import Artifact


@stage("copied", version="1")
def copy(out: Path, source: Source, settings: CaptureSettings) -> dict[str, float]:
    """Write the source's text in capitals."""
    _count(out)
    (out / "text").write_text((source.root / "text").read_text().upper())
    return {}


@stage("doubled", version="1")
def double(out: Path, copied: Artifact) -> dict[str, float]:
    """Write the text twice."""
    _count(out)
    (out / "text").write_text(2 * (copied.root / "text").read_text())
    return {}


@stage("flaky", version="1")
def flaky(out: Path, source: Source) -> dict[str, float]:
    """Fail on the first call, with the error that the source names."""
    _count(out)
    if len(calls(out.parent.parent)) == 1:
        error = {"io": OSError("disk"), "bad": InputError("a.jpg: bad"), "gone": FileNotFoundError("a.jpg")}
        raise error[(source.root / "text").read_text()]
    return {}


def calls(store: Path) -> list[str]:
    """Return the names of the stages that did work in a store, in order."""
    counted = store / "calls"
    return counted.read_text().split() if counted.exists() else []


def _count(out: Path) -> None:
    with (out.parent.parent / "calls").open("a") as counted:
        counted.write(f"{out.parent.name}\n")

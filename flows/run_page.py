"""The page of a flow run: texts, images, links, and the progress of long work."""

import logging
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import cast
from uuid import UUID

from prefect.artifacts import (
    create_link_artifact,
    create_markdown_artifact,
    create_progress_artifact,
    update_progress_artifact,
)
from prefect.context import FlowRunContext

from hnerf.capture.safe_io import read_image
from hnerf.errors import one_line
from hnerf.evaluation.pictures import data_uri, shrunk
from hnerf.progress import Progress, listening

UPDATE_S = 10.0  # between updates of the progress of one piece of work
SLOW_S = 5.0  # for an update; after one that takes longer, the work goes on for ten times as long without another
PICTURE_PX = 640  # longest side on the page; the server stores the bytes in its database

log = logging.getLogger("hnerf.run_page")


def publish_markdown(markdown: str, key: str, description: str) -> None:
    """Publish a text, with its images embedded, on the page of the flow run; do nothing outside a run."""
    _publish(create_markdown_artifact, markdown, key=key, description=description)


def publish_link(path: Path, key: str, description: str) -> None:
    """Publish a link to a file on this machine; do nothing outside a run."""
    _publish(create_link_artifact, path.as_uri(), link_text=str(path), key=key, description=description)


def _publish(create: Callable[..., object], content: str, **options: str) -> None:
    if FlowRunContext.get():
        try:
            create(content, **options)
        except Exception as error:  # the server is away: the results are in the store, and the run has not failed
            log.warning("%s: is not on the page of the run: %s", options["description"], one_line(error))


def embedded(pictures: Sequence[tuple[str, Path]]) -> str:
    """Return Markdown that shows captioned image files, scaled down."""
    return "\n\n".join(
        f"{caption}\n\n![{caption}]({data_uri(shrunk(read_image(path), PICTURE_PX))})" for caption, path in pictures
    )


@contextmanager
def shown_progress() -> Iterator[None]:
    """Show on the page of the flow run the progress of all long work that is reported inside."""
    if not FlowRunContext.get():
        yield
        return
    with listening(_ProgressPage().show):
        yield


class _ProgressPage:
    """One progress artifact for each kind of work, updated every UPDATE_S seconds."""

    def __init__(self) -> None:
        self.artifacts: dict[str, UUID] = {}
        self.next_s: dict[str, float] = {}
        self.silent_until_s = 0.0

    def show(self, progress: Progress) -> None:
        """Show a progress report; if it cannot be shown, the work continues. It waits meanwhile, and Prefect repeats
        the request for minutes if the server is away."""
        key, now = slug(progress.what), time.monotonic()
        ended = progress.done >= progress.total
        due = now >= max(self.silent_until_s, self.next_s.setdefault(key, now + UPDATE_S))
        if not (due or (ended and key in self.artifacts)):
            return
        self.next_s[key] = now + UPDATE_S
        percent = 100.0 * min(1.0, progress.done / progress.total) if progress.total else 100.0
        try:
            if key in self.artifacts:
                update_progress_artifact(self.artifacts[key], percent)
            else:
                self.artifacts[key] = cast(UUID, create_progress_artifact(percent, key=key, description=progress.what))
        except Exception as error:  # the server is away
            log.debug("progress is not shown: %s", error)
        if (took_s := time.monotonic() - now) > SLOW_S:
            self.silent_until_s = now + 11 * took_s
        if ended:
            self.artifacts.pop(key, None)


def slug(text: str) -> str:
    """Convert a text to an artifact key: lower-case letters, digits and dashes."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "work"

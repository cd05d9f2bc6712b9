"""What a command shows while it works: the library's log on standard output, with progress bars on a terminal."""

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from hnerf.progress import Progress, log


@contextmanager
def display() -> Iterator[None]:
    """Show the log instead of using Prefect's console handler, which writes to standard error."""
    logger, level = logging.getLogger("hnerf"), log.level
    handler = TerminalHandler() if sys.stdout.isatty() else LineHandler(sys.stdout)
    times = "%H:%M:%S" if sys.stdout.isatty() else "%Y-%m-%d %H:%M:%S %z"  # a file may be read days later
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s", times))
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False
    if isinstance(handler, TerminalHandler):
        log.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        handler.close()
        logger.propagate = True
        log.setLevel(level)


class LineHandler(logging.StreamHandler):
    """Prints records; ignores it if nobody reads them any more or the disk is full."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Ignore a closed pipe or a full disk, which the command notices at its end."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handleError(record)


class TerminalHandler(logging.Handler):
    """Draws a bar with the remaining time for each work in progress, and prints all other records above the bars."""

    def __init__(self) -> None:
        from rich import progress  # imported only if something is drawn

        super().__init__()
        columns = progress.TextColumn("{task.description}"), progress.BarColumn(), progress.TaskProgressColumn()
        self.bars = progress.Progress(*columns, progress.TimeRemainingColumn(), transient=True)
        self.shown: dict[str, progress.TaskID] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Draw or print a record."""
        at: Progress | None = getattr(record, "progress", None)
        if at is None:
            self.bars.console.print(self.format(record), markup=False, highlight=False, soft_wrap=True)
        elif at.done < at.total:
            if at.what not in self.shown:
                self.shown[at.what] = self.bars.add_task(at.what)
            self.bars.update(self.shown[at.what], completed=at.done, total=at.total)
            self.bars.start()
        elif at.what in self.shown:
            self.bars.remove_task(self.shown.pop(at.what))
            if not self.shown:
                self.bars.stop()  # later output is then not wrapped to the terminal's width

    def close(self) -> None:
        """Remove the bars."""
        self.bars.stop()
        super().close()

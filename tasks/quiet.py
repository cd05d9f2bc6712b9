"""Expected errors in Prefect's logs: one line instead of one traceback for the task and another for the flow."""

import logging

from hnerf.errors import InputError, InvalidAsset
from tasks.bucket import BucketError
from tasks.launcher import LostWorkerError, RankFailedError
from tasks.limits import StalledError

EXPECTED = (InputError, InvalidAsset, BucketError, LostWorkerError, RankFailedError, StalledError)
LOGGERS = ("prefect.task_runs", "prefect.flow_runs", "prefect.engine", "prefect.flow_engine")


def without_traceback(record: logging.LogRecord) -> bool:
    """Remove the traceback from the log record of an error whose message is sufficient (a logging filter); keep all
    records."""
    if record.exc_info and isinstance(record.exc_info[1], EXPECTED):
        record.exc_info = record.exc_text = None
    return True


def quieten() -> None:
    """Apply the filter to the logs of flow and task runs."""
    for name in LOGGERS:
        logging.getLogger(name).addFilter(without_traceback)

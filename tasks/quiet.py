"""Refusals in Prefect's logs: one line in place of a traceback for the task and another for the flow."""

import logging

from hnerf.errors import InputError
from tasks.bucket import BucketError
from tasks.launcher import RankFailedError
from tasks.limits import StalledError

LOGGERS = ("prefect.task_runs", "prefect.flow_runs", "prefect.engine", "prefect.flow_engine")


def without_traceback(record: logging.LogRecord) -> bool:
    """Take the traceback from a record of an error whose message says all (a filter of logging); keep every record."""
    if record.exc_info and isinstance(record.exc_info[1], InputError | BucketError | RankFailedError | StalledError):
        record.exc_info = record.exc_text = None
    return True


def quieten() -> None:
    """Apply this to the logs of flow and task runs."""
    for name in LOGGERS:
        logging.getLogger(name).addFilter(without_traceback)

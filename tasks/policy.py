"""Cache and retry policy: when a stage's result can be reused, when a failed stage is retried, and which errors are
logged in one line instead of one traceback for the task and another for the flow."""

import errno
import hashlib
import json
import logging
import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from prefect.cache_policies import CachePolicy
from prefect.client.schemas.objects import State, TaskRun
from prefect.context import TaskRunContext
from prefect.settings import PREFECT_RESULTS_LOCAL_STORAGE_PATH
from prefect.tasks import Task

from hnerf.config import Section
from hnerf.errors import InputError, InvalidAsset, PlaceError, is_out_of_memory
from tasks.bucket import VARIABLE, BucketError
from tasks.launcher import LostWorkerError, RankFailedError
from tasks.limits import StalledError
from tasks.source import Source
from tasks.store import Artifact, Store, sha256_of

PERMANENT_ERRORS = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
PERMANENT_ERRNOS = (errno.EROFS, errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTEMPTY)  # without an exception class
EXPECTED = (InputError, InvalidAsset, BucketError, LostWorkerError, RankFailedError, StalledError)
LOGGERS = ("prefect.task_runs", "prefect.flow_runs", "prefect.engine", "prefect.flow_engine")

Input = Artifact | Source | Section | str | tuple[str, ...] | tuple[int, ...] | tuple[Artifact, ...] | None


def stage_key(task: str, version: str, inputs: dict[str, Input]) -> str:
    """Return the key of a stage's artifact: a digest of the task's name and version, the content of its inputs, and its
    own settings."""
    described = {name: _key_value(value) for name, value in inputs.items()}
    text = json.dumps({"task": task, "version": version, "inputs": described}, sort_keys=True, default=_file_digest)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def artifacts_among(inputs: Iterable[Input]) -> list[Artifact]:
    """Return the artifacts among a stage's inputs."""
    flat = [one for value in inputs for one in (value if isinstance(value, tuple) else (value,))]
    return [one for one in flat if isinstance(one, Artifact)]


def _key_value(value: Input | int) -> Any:
    if isinstance(value, tuple):
        return [_key_value(one) for one in value]
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, Section):
        return value.key_values()
    if isinstance(value, Source) and not value.is_truth:  # a person may be named after the folder
        return [value.name, value.digest]
    return value.digest


def _file_digest(path: Path) -> str:
    """Return the digest of a file that a setting names, wherever it is, and of files next to it whose names begin with
    its name, like `seg.onnx.data` (external weights). A missing file is represented by its path; the stage refuses
    it."""
    if not path.is_file():
        return str(path)
    beside = sorted(p for p in path.parent.iterdir() if p.name.startswith(path.name) and p != path and p.is_file())
    return " ".join([sha256_of(path), *(f"{p.name.removeprefix(path.name)} {sha256_of(p)}" for p in beside)])


class StorePolicy(CachePolicy):
    """Prefect's cache policy, as a view of the artifact store.

    A task run counts as cached if Prefect's record of it agrees with the store. If an artifact was damaged, deleted or
    made again, its record is dropped here, so that the task runs again. With a bucket, Prefect keeps no records; the
    task itself then looks for its artifact in the store and in the bucket.
    """

    def compute_key(
        self, task_ctx: TaskRunContext, inputs: dict[str, Any], flow_parameters: dict[str, Any], **kwargs: Any
    ) -> str | None:
        """Return the name of Prefect's record: the stage's key and a digest of the store's path, so that different
        stores do not share records. Return None with a bucket."""
        if os.environ.get(VARIABLE):
            return None
        store: Store = inputs["store"]
        task = task_ctx.task
        key = stage_key(task.name, str(task.version), inputs["inputs"])
        place = hashlib.sha256(str(store.root).encode()).hexdigest()[:8]
        record = f"{task.name}-{key}-{place}"
        results = task_ctx.result_store
        with suppress(ValueError):  # Prefect's, if another run has dropped the record meanwhile
            if results.exists(record) and results.read(record).result != store.find(task.name, key):
                (PREFECT_RESULTS_LOCAL_STORAGE_PATH.value() / record).unlink(missing_ok=True)
        return record


def is_transient(task: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    """Tell Prefect whether to retry a failed task run."""
    return is_retryable(state.result(raise_on_failure=False))


def is_retryable(error: object) -> bool:
    """Return whether a retry may succeed: only after failed input or output, timeouts, lack of memory and lost workers,
    or if a stalled stage would continue from a checkpoint."""
    if isinstance(error, StalledError):
        return error.retryable
    if is_out_of_memory(error):
        return True
    return isinstance(error, OSError | LostWorkerError) and not is_permanent(error)


def is_of_the_machine(error: Exception, capture: Path | str | None = None) -> bool:
    """Return whether an error comes from the machine and is no result of a study: a full disk or GPU, a killed
    worker, or a store or bucket that cannot be reached. For a run of a capture, also any failed input or output outside
    the capture's folder, such as a cache on a disk that became read-only."""
    if isinstance(error, PlaceError) or is_retryable(error):
        return True
    return capture is not None and isinstance(error, OSError) and not _lies_in(str(error.filename), capture)


def _lies_in(path: str, capture: Path | str) -> bool:
    return isinstance(capture, Path) and Path(os.path.realpath(path)).is_relative_to(os.path.realpath(capture))


def is_permanent(error: Exception) -> bool:
    """Return whether input or output failed because of the path itself, so that no retry can succeed."""
    return isinstance(error, PERMANENT_ERRORS) or (isinstance(error, OSError) and error.errno in PERMANENT_ERRNOS)


def quieten() -> None:
    """Keep the tracebacks of expected errors, whose message is sufficient, out of the logs of flow and task runs."""
    for name in LOGGERS:
        logging.getLogger(name).addFilter(_without_traceback)


def _without_traceback(record: logging.LogRecord) -> bool:
    if record.exc_info and isinstance(record.exc_info[1], EXPECTED):
        record.exc_info = record.exc_text = None
    return True

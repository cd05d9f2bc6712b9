"""When a stage's work need not be done again, and when it is worth trying again."""

import errno
import hashlib
import json
from pathlib import Path
from typing import Any

from prefect.cache_policies import CachePolicy
from prefect.client.schemas.objects import State, TaskRun
from prefect.context import TaskRunContext
from prefect.settings import PREFECT_RESULTS_LOCAL_STORAGE_PATH
from prefect.tasks import Task

from hnerf.config import Section
from tasks.launcher import LostWorkerError
from tasks.source import Source
from tasks.store import Artifact, Store, sha256_of

LASTING = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
LASTING_NUMBERS = (errno.EROFS, errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTEMPTY)  # which have no class of their own

Input = Artifact | Source | Section | tuple[str, ...] | tuple[int, ...] | tuple[Artifact, ...] | None


def stage_key(task: str, version: str, inputs: dict[str, Input]) -> str:
    """Key of a stage's artifact: digest of the task's name and version, its inputs' content and its own settings."""
    described = {name: _identity(value) for name, value in inputs.items()}
    text = json.dumps({"task": task, "version": version, "inputs": described}, sort_keys=True, default=_content)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _identity(value: Input | str | int) -> Any:
    if isinstance(value, tuple):
        return [_identity(one) for one in value]
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, Section):
        return value.model_dump()
    if isinstance(value, Source):
        return [value.name, value.digest]
    return value.digest


def _content(path: Path) -> str:
    """A file that a setting names counts by its bytes, wherever it lies, and so do those beside it whose names go on
    where its name ends, like `seg.onnx.data`: external weights. One that is missing is for the stage to refuse."""
    if not path.is_file():
        return str(path)
    beside = sorted(p for p in path.parent.iterdir() if p.name.startswith(path.name) and p != path and p.is_file())
    return " ".join([sha256_of(path), *(f"{p.name.removeprefix(path.name)} {sha256_of(p)}" for p in beside)])


class StorePolicy(CachePolicy):
    """Prefect's view of the artifact store.

    A task run counts as cached if Prefect's record of it is what the store has. The record of an artifact that was
    damaged, deleted or made anew is dropped here, so that the task runs again.
    """

    def compute_key(
        self, task_ctx: TaskRunContext, inputs: dict[str, Any], flow_parameters: dict[str, Any], **kwargs: Any
    ) -> str:
        """The record's name: the stage's key, told apart by store so that two stores do not share records."""
        store: Store = inputs["store"]
        task = task_ctx.task
        key = stage_key(task.name, str(task.version), inputs["inputs"])
        place = hashlib.sha256(str(store.root).encode()).hexdigest()[:8]
        record = f"{task.name}-{key}-{place}"
        results = task_ctx.result_store
        if results.exists(record) and results.read(record).result != store.find(task.name, key):
            (PREFECT_RESULTS_LOCAL_STORAGE_PATH.value() / record).unlink()
        return record


def is_transient(task: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    """Prefect's retry condition."""
    return is_retryable(state.result(raise_on_failure=False))


def is_retryable(error: object) -> bool:
    """Whether a later try may overcome it: input and output that failed, timeouts and lost workers; nothing else."""
    return isinstance(error, OSError | LostWorkerError) and not is_permanent(error)


def is_permanent(error: Exception) -> bool:
    """Whether input or output failed for a reason that lies in the path, which no later try overcomes."""
    return isinstance(error, LASTING) or (isinstance(error, OSError) and error.errno in LASTING_NUMBERS)

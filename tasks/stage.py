"""The cached task from which every stage is made."""

import inspect
import json
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

from prefect import Task
from prefect.cache_policies import NO_CACHE
from prefect.context import FlowRunContext
from prefect.tasks import exponential_backoff

from hnerf.models import has_model
from tasks.bucket import Bucket
from tasks.limits import limited
from tasks.policy import Input, StorePolicy, artifacts_among, is_transient, quieten, stage_key
from tasks.shared import get_or_compute
from tasks.store import Artifact, Store

log = logging.getLogger("hnerf.stage")
quieten()

P = ParamSpec("P")
T = TypeVar("T")
CAPTURE = "capture.json"  # of a recording, hnerf/capture/capture.py
NETWORKS = "networks"  # in a stage's key, in addition to its own inputs
RETRIES: dict[str, Any] = {
    "retries": 3,
    "retry_delay_seconds": exponential_backoff(backoff_factor=10),
    "retry_jitter_factor": 0.5,
    "retry_condition_fn": is_transient,
}
Write = Callable[Concatenate[Path, P], dict[str, float]]


@dataclass(eq=False)
class Stage(Generic[P]):
    """A function `write(out, inputs...)` that fills a folder, made into a cached task.

    It is called as `stage(store, inputs...)`. Within a flow run it is a Prefect task run; elsewhere it does the same
    work through the same store, without a server.

    networks: files of hnerf.models that the stage uses if they are installed; the key depends on which ones are.
    shared: whether the artifact is shared through the bucket, if there is one; checkpoint: the file of unfinished work
    that is shared there, too, and is not part of the artifact.
    """

    write: Write[P]
    name: str
    version: str
    resumable: bool = False
    networks: tuple[str, ...] = ()
    shared: bool = True
    checkpoint: str = ""

    def __post_init__(self) -> None:
        self.task: Task[..., Artifact] = Task(
            fn=self._run,
            name=self.name,
            description=self.write.__doc__,
            version=self.version,
            cache_policy=StorePolicy(),
            persist_result=True,
            result_serializer="json",
            cache_result_in_memory=False,
            **RETRIES,
        )

    def __call__(self, store: Store, *args: P.args, **kwargs: P.kwargs) -> Artifact:
        _, *parameters = inspect.signature(self.write).parameters.values()
        inputs = inspect.Signature(parameters).bind(*args, **kwargs)
        inputs.apply_defaults()
        found: dict[str, Input] = dict(inputs.arguments)
        if self.networks:
            found[NETWORKS] = tuple(name for name in self.networks if has_model(name))
        run = self.task if FlowRunContext.get() else self.task.fn
        return run(store=store, inputs=found)

    def _run(self, store: Store, inputs: dict[str, Input]) -> Artifact:
        log.info("%s", self.name)
        key = stage_key(self.name, self.version, inputs)
        given = {name: value for name, value in inputs.items() if name != NETWORKS}
        names = [one.name for one in artifacts_among(given.values())]

        def write(out: Path) -> dict[str, float]:
            with limited(self.name, image_count(given.values()), self.resumable):
                return self.write(out, **given)  # type: ignore[call-arg, arg-type]

        def compute() -> Artifact:
            return store.get_or_compute(self.name, key, write, self.resumable, names, self.checkpoint)

        bucket = Bucket.configured() if self.shared else None
        return get_or_compute(bucket, store, self.name, key, compute, self.checkpoint) if bucket else compute()


def retried(function: Callable[P, T]) -> Callable[P, T]:
    """Return a function that, within a flow run, is a task that is retried like a stage, and is never cached."""
    if not FlowRunContext.get():
        return function
    return Task(fn=function, cache_policy=NO_CACHE, persist_result=False, **RETRIES)


def image_count(inputs: Iterable[Input]) -> int:
    """Return the number of images (frames times cameras) of the largest recording among a stage's inputs; 1 if there is
    none."""
    roots = [one.root for one in artifacts_among(inputs) if (one.root / CAPTURE).is_file()]
    recordings = [json.loads((root / CAPTURE).read_bytes()) for root in roots]
    counts = [len(one["cameras"]) * len(one["train_frames"] + one["novel_pose_frames"]) for one in recordings]
    return max(counts, default=1)


def stage(name: str, version: str, **options: Any) -> Callable[[Write[P]], Stage[P]]:
    """Decorate a function to make it a Stage with these options. Artifacts are under `<store>/<name>/`; raise `version`
    when the same inputs give a different result."""
    return lambda write: Stage(write, name, version, **options)

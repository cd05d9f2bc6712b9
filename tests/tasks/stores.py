"""Small stores for tests. A run of a subject leaves capture -> rough fit -> fit -> training -> evaluation and asset."""

import json
import os
from pathlib import Path

from tasks.store import Artifact, Store

LONG_AGO_S = 1_600_000_000.0


def add(store: Store, stage: str, number: int, *inputs: Artifact, name: str = "") -> Artifact:
    """Add an artifact whose key is a number, made that many seconds after LONG_AGO_S."""

    def write(out: Path) -> dict[str, float]:
        (out / "deep").mkdir()
        (out / "deep" / "letters").write_text(f"abc {number}")
        if name:
            (out / "capture.json").write_text(json.dumps({"name": name}))
        return {}

    key = f"{number:032x}"
    made = store.get_or_compute(stage, key, write, inputs=[one.name for one in inputs])
    for path in (made.root, store.path(stage, key, ".json")):
        os.utime(path, (LONG_AGO_S + number,) * 2)
    return made


def run_of(store: Store, subject: str, first: int) -> list[Artifact]:
    """Add the artifacts of a run, with keys from `first` on. The rough fit, with key `first` + 1, has no link."""
    capture = store.link_latest(subject, add(store, "capture", first, name=subject))
    rough = add(store, "fit", first + 1, capture)
    fit = store.link_latest(subject, add(store, "fit", first + 2, capture, rough))
    training = store.link_latest(subject, add(store, "training", first + 3, fit))
    ends = [store.link_latest(subject, add(store, stage, first + 4, training)) for stage in ("evaluation", "asset")]
    return [capture, rough, fit, training, *ends]


def names(artifacts: list[Artifact]) -> set[str]:
    """Return the artifacts' names."""
    return {one.name for one in artifacts}

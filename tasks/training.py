"""The training stage: the radiance field and the clothed surface."""

import json
from pathlib import Path

import torch

from hnerf.config import TrainingSettings
from hnerf.errors import PlaceError
from hnerf.training.checkpoint import NAME
from tasks.launcher import run_ranks
from tasks.stage import stage
from tasks.store import Artifact


@stage("training", version="44", resumable=True, checkpoint=NAME)
def train(
    out: Path,
    recording: Artifact,
    calibration: Artifact,
    segmentation: Artifact,
    body: Artifact,
    settings: TrainingSettings,
) -> dict[str, float]:
    """Train with one process per GPU; resume from the checkpoint of an interrupted run."""
    inputs = [str(artifact.root) for artifact in (recording, calibration, segmentation, body)]
    gpus = torch.cuda.device_count()
    if 0 < gpus < settings.processes:
        raise PlaceError(
            f"training.processes={settings.processes}: each process needs a GPU, and this machine has {gpus}; "
            "lower it, or leave it out"
        )
    processes = settings.processes or max(1, gpus)
    run_ranks("hnerf.training.run", [*inputs, settings.model_dump_json(), str(out)], processes)
    report = json.loads((out / "report.json").read_text())
    return {name: report[name] for name in ("steps", "seconds", "peak_memory_gib", "model_mib")}

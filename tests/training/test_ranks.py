"""Training with two processes."""

import json
import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from hnerf.training.checkpoint import NAME
from hnerf.training.trainer import train
from tests.training.first_step import KINDS, gradients, untrained
from tests.training.scene import ALONE, TINY, record


@pytest.fixture(scope="module")
def two_ranks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run `two_ranks.py` as two processes; return its output folder: first steps by kind of field, and a training that
    was killed, so torchrun must fail."""
    folder = tmp_path_factory.mktemp("two")
    for name in (*KINDS, "killed"):
        (folder / name).mkdir()
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1"}
    ended = subprocess.run([*command, "-m", "tests.training.two_ranks", str(folder), "3"], env=environment)
    assert ended.returncode != 0
    return folder


@pytest.mark.parametrize("kind", KINDS)
def test_two_ranks_in_three_parts_have_the_gradients_of_one_batch(tmp_path: Path, two_ranks: Path, kind: str) -> None:
    """Two gloo processes with half of the 128 rays each, in parts of 22 and 21, have the gradients of one process with
    all rays. Both skip a step in which the loss of only one of them is not finite."""
    alone = untrained(tmp_path / "one", kind, ALONE)
    one, root = gradients(alone, alone.objective), two_ranks / kind
    two = torch.load(root / "gradients.pt", weights_only=True)
    for learned in ("correction", "deformation") if kind == "fast" else ("correction", "radiance"):
        assert any(g.abs().max() > 0 for name, g in one.items() if learned in name)
    torch.testing.assert_close(two, one, atol=1e-6, rtol=1e-4)
    assert [(root / f"skipped{rank}").read_text() for rank in (0, 1)] == ["1", "1"]


@pytest.mark.usefixtures("any_surface")
def test_one_process_resumes_the_training_of_two_killed_processes(
    tmp_path: Path, two_ranks: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It continues from the checkpoint at step 6 to the end, and is as accurate as one process from the start."""
    killed, whole = two_ranks / "killed", tmp_path / "whole"
    whole.mkdir()
    assert (killed / NAME).exists() and not (killed / "model.safetensors").exists()
    scene = record(tmp_path / "capture")
    with caplog.at_level(logging.INFO, "hnerf.training"):
        train(*scene, TINY, killed, ALONE)
    assert "resumed at step 6" in caplog.text
    train(*scene, TINY, whole, ALONE)
    ends = [json.loads((out / "history.jsonl").read_text().splitlines()[-2]) for out in (killed, whole)]
    assert ends[0]["step"] == ends[1]["step"] == TINY.steps
    assert ends[0]["held_out"]["psnr"] == pytest.approx(ends[1]["held_out"]["psnr"], abs=0.2)

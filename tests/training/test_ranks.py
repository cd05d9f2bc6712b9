"""A training that is begun by two processes and ended by one."""

import json
import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from hnerf.training import trainer as trainer_module
from hnerf.training.checkpoint import NAME
from hnerf.training.processes import Processes
from hnerf.training.trainer import train
from tests.training.scene import TINY, record

ALONE = Processes(0, 1, torch.device("cpu"))
RANK = """
import os, signal, sys, torch
from pathlib import Path
from hnerf.training.processes import Processes
from hnerf.training.trainer import Trainer
from tests.training.scene import TINY, record
torch.set_num_threads(1)
root, optimise, p = Path(sys.argv[1]), Trainer._optimise, Processes.join()

def killed_at_eight(self, module):
    if self.step == 8 and p.rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return optimise(self, module)

Trainer._optimise = killed_at_eight
Trainer(*record(root / f"capture{p.rank}"), TINY, root, p).run()
"""


def test_one_process_goes_on_where_two_were_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """From the checkpoint at step six to the end, as well as one process does from the start."""
    monkeypatch.setattr(trainer_module, "LEAST_COVERAGE", 0.0)
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    killed.mkdir(), whole.mkdir()
    (tmp_path / "rank.py").write_text(RANK)
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1"}
    ended = subprocess.run([*launcher, str(tmp_path / "rank.py"), str(killed)], env=environment, capture_output=True)
    assert ended.returncode != 0 and (killed / NAME).exists() and not (killed / "model.safetensors").exists()
    scene = record(tmp_path / "capture")
    with caplog.at_level(logging.INFO, "hnerf.training"):
        train(*scene, TINY, killed, ALONE)
    assert "resumed at step 6" in caplog.text
    train(*scene, TINY, whole, ALONE)
    ends = [json.loads((out / "history.jsonl").read_text().splitlines()[-2]) for out in (killed, whole)]
    assert ends[0]["step"] == ends[1]["step"] == TINY.steps
    assert ends[0]["held_out"]["psnr"] == pytest.approx(ends[1]["held_out"]["psnr"], abs=0.2)

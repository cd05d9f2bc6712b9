"""Trainings by two processes."""

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
KILLED = """
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


def launched(ranks: int, script: Path, root: Path) -> int:
    """The exit status of torchrun with so many processes of the script."""
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={ranks}"]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1"}
    return subprocess.run([*launcher, str(script), str(root)], env=environment).returncode


GRADIENTS = """
import sys, torch
from pathlib import Path
from hnerf.training import trainer
from hnerf.training.processes import Processes
from tests.training.scene import TINY, record
torch.set_num_threads(1)
root = Path(sys.argv[1])
p = Processes.join()
settings = TINY.model_copy(update={"losses": TINY.losses.model_copy(update={"elastic": 0.1})})
t = trainer.Trainer(*record(root / f"capture{p.rank}"), settings, root, p)
t.field.deformation.displacement.data[:-1] = 0.01
module = t.objective
if p.world_size > 1:
    module = torch.nn.parallel.DistributedDataParallel(module, find_unused_parameters=True)
t.optimizer.step = lambda: None
t._optimise(module)
if p.leads:
    torch.save({n: q.grad for n, q in t.objective.named_parameters() if q.grad is not None}, root / "gradients.pt")
"""


def test_two_ranks_have_the_gradients_of_one(tmp_path: Path):
    """Two gloo processes with half the rays each: the averaged gradients are those of one process with all rays."""
    gradients = []
    for ranks in (1, 2):
        root = tmp_path / f"{ranks}"
        root.mkdir()
        script = root / "rank.py"
        script.write_text(GRADIENTS)
        assert launched(ranks, script, root) == 0
        gradients.append(torch.load(root / "gradients.pt", weights_only=True))
    assert gradients[0].keys() == gradients[1].keys()
    for learned in ("correction", "deformation"):
        assert any(g.abs().max() > 0 for name, g in gradients[0].items() if learned in name)
    for name, gradient in gradients[0].items():
        torch.testing.assert_close(
            gradients[1][name], gradient, atol=1e-6, rtol=1e-4, msg=lambda m, n=name: f"{n}: {m}"
        )


def test_one_process_goes_on_where_two_were_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """From the checkpoint at step six to the end, as well as one process does from the start."""
    monkeypatch.setattr(trainer_module, "LEAST_COVERAGE", 0.0)
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    killed.mkdir(), whole.mkdir()
    (tmp_path / "rank.py").write_text(KILLED)
    assert launched(2, tmp_path / "rank.py", killed) != 0
    assert (killed / NAME).exists() and not (killed / "model.safetensors").exists()
    scene = record(tmp_path / "capture")
    with caplog.at_level(logging.INFO, "hnerf.training"):
        train(*scene, TINY, killed, ALONE)
    assert "resumed at step 6" in caplog.text
    train(*scene, TINY, whole, ALONE)
    ends = [json.loads((out / "history.jsonl").read_text().splitlines()[-2]) for out in (killed, whole)]
    assert ends[0]["step"] == ends[1]["step"] == TINY.steps
    assert ends[0]["held_out"]["psnr"] == pytest.approx(ends[1]["held_out"]["psnr"], abs=0.2)

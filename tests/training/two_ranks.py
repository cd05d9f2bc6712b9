"""The program that test_ranks.py runs as two processes under torchrun: a first step of each kind of field, then a
training in which one process is killed. It is a single program because starting one takes seconds.

usage: python -m torch.distributed.run --nproc-per-node=2 -m tests.training.two_ranks FOLDER PARTS
"""

import os
import signal
import sys
from pathlib import Path

import torch
from torch import Tensor

from hnerf.training.distributed import Distributed
from hnerf.training.trainer import Trainer
from tests.training.first_step import KINDS, write_first_step
from tests.training.scene import SHRUNK_CONSTANTS, TINY, record

KILLED_AT = 8  # two steps after the checkpoint


class KilledTrainer(Trainer):
    """A trainer whose second process is killed at step KILLED_AT."""

    def _optimise(self, module: torch.nn.Module) -> dict[str, Tensor]:
        if self.step == KILLED_AT and self.processes.rank == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return super()._optimise(module)


def main(folder: Path, parts: int) -> None:
    """Write the results that test_ranks.py checks into folders that it has created."""
    torch.set_num_threads(1)
    for module, name, value in SHRUNK_CONSTANTS:
        setattr(module, name, value)
    processes = Distributed.join()
    for kind in KINDS:
        write_first_step(folder / kind, kind, parts, processes)
    KilledTrainer(*record(folder / f"capture{processes.rank}"), TINY, folder / "killed", processes).run()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))

"""What two processes under torchrun do for test_ranks.py: a first step of each kind, then a training in which one of
them is killed. In one program, because it takes seconds to start.

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
    """A training of which the second process is killed."""

    def _optimise(self, module: torch.nn.Module) -> dict[str, Tensor]:
        if self.step == KILLED_AT and self.processes.rank == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return super()._optimise(module)


def main(folder: Path, parts: int) -> None:
    """Write what test_ranks.py looks at, in folders that it made."""
    torch.set_num_threads(1)
    for module, name, value in SHRUNK_CONSTANTS:
        setattr(module, name, value)
    processes = Distributed.join()
    for kind in KINDS:
        write_first_step(folder / kind, kind, parts, processes)
    KilledTrainer(*record(folder / f"capture{processes.rank}"), TINY, folder / "killed", processes).run()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))

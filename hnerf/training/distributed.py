"""Processes that train one subject together: rank, world size and device."""

import os
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor

PATIENCE = timedelta(hours=12)  # of processes that wait while one gathers pixels; the stage's own limit ends a hang


@dataclass(frozen=True)
class Distributed:
    """This process in its group as started by torchrun; a group of one without torchrun."""

    rank: int
    world_size: int
    device: torch.device

    @staticmethod
    def join() -> "Distributed":
        """Join the group that torchrun's environment describes: NCCL with one GPU per rank, else gloo on the CPU."""
        rank, world_size = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
        cuda = torch.cuda.is_available()
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0))) if cuda else torch.device("cpu")
        if cuda:
            torch.cuda.set_device(device)
        if world_size > 1 and not dist.is_initialized():
            dist.init_process_group("nccl" if cuda else "gloo", timeout=PATIENCE)
        return Distributed(rank, world_size, device)

    def all_max(self, value: float) -> float:
        """Return the greatest value of all processes."""
        if self.world_size == 1:
            return value
        found = torch.tensor(value, dtype=torch.float64, device=self.device)
        dist.all_reduce(found, dist.ReduceOp.MAX)
        return float(found)

    def all_sum(self, values: Tensor) -> Tensor:
        """Return the sum of the tensors of all processes, which it may overwrite."""
        if self.world_size > 1:
            dist.all_reduce(values)
        return values

    def barrier(self) -> None:
        """Block until every process has reached this call."""
        if self.world_size > 1:
            dist.barrier()

    @property
    def is_main(self) -> bool:
        """Return whether this process writes files and logs."""
        return self.rank == 0

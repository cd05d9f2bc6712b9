"""Gradient accumulation: the rays of a step are divided into as many parts as memory requires, whose gradients add up
to those of the joint batch."""

import math
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from hnerf.fields.conditions import Draws, shard
from hnerf.fields.rays import PosedScene
from hnerf.training.auto_settings import Decision
from hnerf.training.distributed import Distributed
from hnerf.training.pixels import PixelRays

CPU_PARTS = 2  # in parallel on a CPU, because operations are too small to share cores; a sum of two is deterministic
USABLE_SHARE = 0.8  # of the free memory, for fragmentation and differences between rays
PEAK_FACTOR = 1.3  # CPU peak relative to tensors saved for gradients: 1.26 to 1.29 by hand (`fast`, `paper`)
FEW_RAYS, MORE_RAYS = 32, 64  # of the trial batches
GIB = 2**30
MEMINFO = Path("/proc/meminfo")


class Parts:
    """Parts of a process's rays: `count` of them, in parallel threads or one after another. most_rays: how many fit
    into memory at once."""

    def __init__(self, count: int, side_by_side: bool, most_rays: float):
        self.count, self.most_rays, self.pool = count, most_rays, None
        if side_by_side:
            threads = torch.get_num_threads() // count
            self.pool = ThreadPoolExecutor(count, "part", torch.set_num_threads, (threads,))

    def backward(
        self, module: nn.Module, scene: PosedScene[Any], rays: PixelRays, draws: Draws, processes: Distributed
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Add the gradients of this process's share of a joint batch to the parameters' gradients; return the losses by
        name, and the colour errors (R,) of the joint batch.

        Losses are means over rays, or do not depend on them: weighted by their numbers of rays, the parts add up to the
        joint batch. `module` averages over processes at the last part.
        """
        n, world_size = self.count, processes.world_size
        errors = torch.zeros(len(rays), device=rays.colour.device)

        def of_part(part: int) -> dict[str, Tensor]:
            mine = processes.rank * n + part, world_size * n
            part_rays = shard(rays, *mine)
            weight = world_size * len(part_rays) / len(rays)
            waiting = module if part < n - 1 and isinstance(module, DistributedDataParallel) else None
            with waiting.no_sync() if waiting else nullcontext():
                terms, part_errors = module(scene, part_rays, shard(draws, *mine))
                (weight * torch.stack(list(terms.values())).sum()).backward()
            rank, count = mine
            errors.tensor_split(count)[rank].copy_(part_errors)
            return {name: weight * term.detach() for name, term in terms.items()}

        found = list(self.pool.map(of_part, range(n))) if self.pool else [of_part(part) for part in range(n)]
        joint = {name: torch.stack([terms[name] for terms in found]).sum() for name in found[0]}
        return joint, processes.all_sum(errors)


def decide_parts(
    rays: int, memory_gib: float | None, trial_loss: Callable[[int], tuple[int, Tensor]], processes: Distributed
) -> tuple[Parts, Decision]:
    """Decide into how many parts each process divides `rays` per step; return the parts and the reason.

    memory_gib: memory for them; None: all that is free. trial_loss: maps an approximate number of rays to the number
    and loss of a trial batch. Two small batches are measured: their difference is due to the rays, the rest is a
    constant.
    """
    device, share = processes.device, math.ceil(rays / processes.world_size)
    if device.type == "cuda":
        _peak_bytes(trial_loss, FEW_RAYS, device)  # libraries allocate some memory only once
    (few, least), (more, most) = (_peak_bytes(trial_loss, about, device) for about in (FEW_RAYS, MORE_RAYS))
    each = max(1.0, (most - least) / (more - few))
    room = USABLE_SHARE * _free_bytes(processes) if memory_gib is None else memory_gib * GIB
    most_rays = max(1.0, (room - least) / each + few)
    count = int(processes.all_max(min(math.ceil(share / most_rays), max(1, share // 2))))
    reason = "there is room for a step's rays"  # without figures, so that identical runs record the same reason
    if memory_gib or count > 1:
        needed_gib = (least + (share - few) * each) / GIB
        reason = f"a ray needs {each / 2**20:.2f} MiB, {share} rays {needed_gib:.2f} GiB, of {room / GIB:.1f} GiB"
    side_by_side = count == 1 and device.type == "cpu" and processes.world_size == 1 and torch.get_num_threads() > 1
    if side_by_side:
        count, reason = CPU_PARTS, f"{reason}, side by side in threads"
    return Parts(count, side_by_side, most_rays), Decision(count, reason)


def _peak_bytes(trial_loss: Callable[[int], tuple[int, Tensor]], about: int, device: torch.device) -> tuple[int, float]:
    """Return the number of rays of a small batch, and the peak memory of a step with them: as allocated on a GPU; on a
    CPU, which has no such counter, in proportion to the tensors saved for gradients."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        rays, loss = trial_loss(about)
        loss.backward()
        return rays, torch.cuda.max_memory_allocated(device) - before
    saved = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        saved[storage.data_ptr()] = storage  # kept alive, so that its address is not reused
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        rays, _ = trial_loss(about)
    return rays, PEAK_FACTOR * sum(storage.nbytes() for storage in saved.values())


def _free_bytes(processes: Distributed) -> float:
    """Return the free memory of this process's GPU, or its share of the machine's; sys.maxsize if that is unknown."""
    device = processes.device
    if device.type == "cuda":
        kept = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + kept
    message = MEMINFO.read_text().splitlines() if MEMINFO.exists() else []
    free = [1024 * int(line.split()[1]) for line in message if line.startswith("MemAvailable:")]
    return free[0] / processes.world_size if free else sys.maxsize

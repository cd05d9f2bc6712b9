"""The first step of a training, with any number of processes."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from hnerf.config import LossSettings
from hnerf.training.distributed import Distributed
from hnerf.training.parts import Parts
from hnerf.training.trainer import Trainer
from tests.training.scene import record, tiny


def untrained(folder: Path, kind: str, processes: Distributed, memory_gib: float | None = None) -> Trainer:
    """Return a trainer with all losses and a deformation, whose steps compute gradients but change nothing."""
    losses = LossSettings(elastic=0.1 if kind == "fast" else 0.0)
    settings = tiny(kind, losses=losses, memory_gib=memory_gib)
    trainer = Trainer(*record(folder / f"capture{processes.rank}"), settings, folder, processes)
    if kind == "fast":
        trainer.field.deformation.displacement.data[:-1] = 0.01
    trainer.optimizer.step = lambda: None  # type: ignore[method-assign]
    return trainer


def gradients(trainer: Trainer, module: torch.nn.Module) -> dict[str, Tensor]:
    """Return the gradients of one step, by name of the parameter, and the errors by cell."""
    trainer._optimise(module)
    found = {name: q.grad.clone() for name, q in trainer.objective.named_parameters() if q.grad is not None}
    return found | ({"errors": trainer.errors.mean.clone()} if trainer.errors else {})


KINDS = ("fast", "paper")


def write_first_step(folder: Path, kind: str, parts: int, processes: Distributed) -> None:
    """Write the gradients of a step, and how many steps each rank skips if one rank's loss is not finite."""
    trainer = untrained(folder, kind, processes)
    trainer.parts = Parts(parts, False, 1e9)
    module = DistributedDataParallel(trainer.objective, find_unused_parameters=True)
    found = gradients(trainer, module)
    if processes.is_main:
        torch.save(found, folder / "gradients.pt")
    assert trainer.skipped == 0
    forward, odd = trainer.objective.forward, torch.tensor(float("nan") if processes.rank else 0.0)

    def odd_forward(*batch: Any) -> tuple[dict[str, Tensor], Tensor]:
        terms, errors = forward(*batch)
        return terms | {"odd": odd}, errors

    trainer.objective.forward = odd_forward  # type: ignore[method-assign]
    finite = gradients(trainer, module)
    assert all(gradient.isfinite().all() for gradient in finite.values())  # only the loss is not
    (folder / f"skipped{processes.rank}").write_text(str(trainer.skipped))

"""Gradient accumulation: the parts of a batch add up to the gradients of the whole; memory determines their number."""

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from hnerf.fields.conditions import Draws
from hnerf.training import fixed_rays
from hnerf.training import parts as parts_module
from hnerf.training.distributed import Distributed
from hnerf.training.parts import GIB, PEAK_FACTOR, USABLE_SHARE, Parts, decide_parts
from hnerf.training.pixels import PixelRays
from tests.training.first_step import gradients, untrained
from tests.training.scene import ALONE

CPU = torch.device("cpu")


class Scale(nn.Module):
    """Losses of a parameter w: the mean of w x over rays, and 3 w, which does not depend on rays; errors x."""

    def __init__(self) -> None:
        super().__init__()
        self.w = nn.Parameter(torch.tensor(2.0, dtype=torch.float64))

    def forward(self, scene: object, rays: PixelRays, draws: Draws) -> tuple[dict[str, Tensor], Tensor]:
        """Return `mean` and `increment`, and the errors."""
        assert len(draws.jitter) == len(rays.frame) > 0
        x = rays.origins_m[:, 0]
        return {"mean": (self.w * x).mean(), "increment": 3 * self.w}, x


@pytest.mark.parametrize(
    ("world_size", "count", "side_by_side"), [(1, 1, False), (1, 2, True), (1, 3, False), (2, 3, False)]
)
def test_parts_of_unequal_size_add_up_to_the_whole_batch(
    monkeypatch: pytest.MonkeyPatch, world_size: int, count: int, side_by_side: bool
) -> None:
    """x is 1 to 7 for seven rays, with a mean of 4: d/dw = 4 + 3. Three parts of 3, 2 and 2 rays have means of 2, 4.5
    and 6.5, whose unweighted mean would be 4.33. Two processes with three parts each have one part of two rays and five
    of one ray. A process knows the errors of its own rays."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(Distributed, "all_sum", lambda self, values: values)
    x = torch.arange(1.0, 8, dtype=torch.float64)[:, None].expand(7, 3)
    rays = PixelRays(x, x, torch.zeros(7, dtype=torch.long), x, x[:, 0] > 0, x[:, 0] > 0, None)
    means, slopes, errors = [], [], torch.zeros(7)
    for rank in range(world_size):
        module = Scale()
        terms, found = Parts(count, side_by_side, 7).backward(
            module, None, rays, Draws.deterministic(7, 1, CPU), Distributed(rank, world_size, CPU)
        )
        errors += found
        means.append(terms["mean"].item())
        slopes.append(module.w.grad.item())
    assert sum(slopes) / world_size == pytest.approx(7, rel=1e-14)
    assert sum(means) / world_size == pytest.approx(8, rel=1e-14)  # 4 w
    assert errors.tolist() == [1, 2, 3, 4, 5, 6, 7]


def attempted(about: int) -> tuple[int, Tensor]:
    """Return the ray count and a loss that saves 1024 doubles per ray, and 1000 in addition."""
    learned = torch.ones((), dtype=torch.float64, requires_grad=True)
    both = [learned * torch.ones(n, dtype=torch.float64) for n in (1024 * about, 1000)]
    return about, both[0].sum() + both[1].sum()


@pytest.mark.parametrize(("rays", "world_size", "parts"), [(100, 1, 1), (101, 1, 2), (1000, 1, 10), (1000, 4, 3)])
def test_the_number_of_parts_follows_from_the_memory_per_ray(
    monkeypatch: pytest.MonkeyPatch, rays: int, world_size: int, parts: int
) -> None:
    """A ray needs 8 KiB, a batch 8000 bytes more; the memory, given or free, has room for 100.5 rays."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    monkeypatch.setattr(Distributed, "all_max", lambda self, value: value)
    room = PEAK_FACTOR * (8000 + 8192 * 100.5)
    processes = Distributed(0, world_size, CPU)
    made, decision = decide_parts(rays, room / GIB, attempted, processes)
    assert made.count == decision.value == parts
    assert made.most_rays == pytest.approx(100.5, abs=0.01)
    assert decision.reason.startswith("a ray needs 0.01 MiB")
    monkeypatch.setattr(parts_module, "_free_bytes", lambda processes: room / USABLE_SHARE)
    assert decide_parts(rays, None, attempted, processes)[0].count == parts


def test_on_a_cpu_a_batch_that_fits_runs_as_two_parallel_halves(monkeypatch: pytest.MonkeyPatch) -> None:
    """With two threads, two halves run in parallel; if that does not fit, parts run one after another."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    made, decision = decide_parts(100, 1.0, attempted, ALONE)
    assert made.count == decision.value == 2 and made.pool is not None
    made, _ = decide_parts(100, PEAK_FACTOR * (8000 + 8192 * 50.5) / GIB, attempted, ALONE)
    assert made.count == 2 and made.pool is None


@pytest.mark.usefixtures("any_surface")
def test_parallel_halves_have_the_gradients_of_the_whole_batch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of a CPU with two threads are the same bit by bit each time, whichever half ends first, and equal those of
    one batch except for the order of sums."""
    found = []
    for threads in (1, 2, 2):
        monkeypatch.setattr(torch, "get_num_threads", lambda n=threads: n)
        trainer = untrained(tmp_path, "fast", ALONE)
        assert trainer.parts.count == threads
        found.append(gradients(trainer, trainer.objective))
    whole, halves, again = found
    assert any("correction" in name for name in whole)
    torch.testing.assert_close(halves, whole, atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(halves, again, atol=0, rtol=0)


@pytest.mark.parametrize("kind", ["fast", "paper"])
def test_memory_changes_the_number_of_parts_and_not_the_gradients(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """128 rays of 1 MB each in 50 MB: parts of 43, 43 and 42. Evaluation during training is split in the same way."""
    monkeypatch.setattr(fixed_rays, "RAYS", 300)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    monkeypatch.setattr(parts_module, "_peak_bytes", lambda trial_loss, about, device: (about, 1e6 * about))
    found = []
    for memory_gib, count in ((None, 1), (50e6 / GIB, 3)):
        trainer = untrained(tmp_path, kind, ALONE, memory_gib=memory_gib)
        assert trainer.parts.count == count
        psnr = trainer.fixed_rays.psnr(trainer.scene, trainer.novel_rows)
        found.append(gradients(trainer, trainer.objective) | {"psnr": torch.tensor(psnr)})
    torch.testing.assert_close(found[1], found[0], atol=1e-6, rtol=1e-4)

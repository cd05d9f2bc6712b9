"""Root condition: whether the paper's colour depends on the root transform T. Its density never does."""

import pytest
import torch
from torch import Tensor

from hnerf.body.canonical import PosedBodies
from hnerf.config import PaperFieldSettings
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.paper import PaperField
from hnerf.fields.rays import Rays
from tests.body.boxes import box_rig

RIG = box_rig()


def seen(field: PaperField, root_condition: Tensor) -> tuple[Tensor, Tensor]:
    """Return density and colour along one ray through the box for a given root condition."""
    bodies = PosedBodies(RIG, torch.zeros(1, 2, 3), torch.eye(4)[None], RIG.vertices_m)
    moment = torch.zeros(1, dtype=torch.long)
    conditions = Conditions(Conditions.of(RIG, bodies.theta, bodies.root, moment, 2.5).pose, root_condition, moment)
    ray = Rays(torch.tensor([[0.5, 0.4, 2.4]]), torch.tensor([[0.0, 0.0, -1.0]]), torch.zeros(1, dtype=torch.long))
    draws = Draws.deterministic(1, field.samples, torch.device("cpu"))
    samples, _ = field.sample(field.scene(bodies, conditions), ray, draws)
    assert samples.in_box.any()
    return samples.density, samples.colour


@pytest.mark.parametrize(("root_condition", "inputs", "depends"), [(True, 256 + 12 + 3, True), (False, 256 + 3, False)])
def test_colour_depends_on_the_root_only_if_conditioned(root_condition: bool, inputs: int, depends: bool) -> None:
    torch.manual_seed(0)
    settings = PaperFieldSettings(samples=8, root_condition=root_condition)
    field = PaperField(RIG, torch.eye(4)[None], settings, static=False)
    assert field.radiance.colour[0].in_features == inputs
    here, there = seen(field, torch.zeros(1, 12)), seen(field, torch.ones(1, 12))
    assert torch.equal(here[0], there[0])
    assert torch.equal(here[1], there[1]) is not depends

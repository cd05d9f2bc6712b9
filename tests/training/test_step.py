"""Targets of a step, and the inputs of each of its losses."""

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

from hnerf.body.canonical import PoseCorrection
from hnerf.config import LossSettings, PaperFieldSettings, TrainingSettings
from hnerf.fields.conditions import Draws
from hnerf.fields.rays import PosedScene
from hnerf.fields.samples import RaySamples
from hnerf.training import losses
from hnerf.training.pixels import PixelRays
from hnerf.training.step import Objective, make_target
from tests.training.test_losses import SAMPLES, TARGET

BEYOND, SEEN, PLATE = torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(0))
PERSON = torch.tensor([True, True, False, False])
EDGE = torch.tensor([False, True, True, False])


def target_of(plate: Tensor | None, models_background: bool = False) -> losses.Target:
    """Return the target of four pixels: in the person, on both sides of the outline, in the background."""
    none = torch.zeros(4, 3)
    rays = PixelRays(none, none, torch.zeros(4, dtype=torch.long), SEEN, PERSON, EDGE, plate)
    return make_target(rays, BEYOND, models_background)


@pytest.mark.parametrize("plate", [None, PLATE])
def test_the_target_of_a_field_with_background_is_the_photograph(plate: Tensor | None) -> None:
    target = target_of(plate, models_background=True)
    assert torch.equal(target.colour, SEEN)
    assert target.weight.tolist() == [1, 1, 1, 1]
    assert target.person.tolist() == [1, 1, 0, 0]
    assert not target.background.any()


def test_over_a_clean_plate_every_pixel_counts() -> None:
    """Outline pixels, which mix person and plate, keep the photographed colour; background pixels get the plate's."""
    target = target_of(PLATE)
    assert torch.equal(target.colour, torch.cat([SEEN[:3], PLATE[3:]]))
    assert target.weight.tolist() == [1, 1, 1, 1]
    assert target.person.tolist() == [1, 1, 0, 0]
    assert torch.equal(target.background, PLATE)


def test_without_a_plate_surroundings_are_random_and_the_outline_is_left_out() -> None:
    target = target_of(None)
    assert torch.equal(target.colour[[0, 3]], torch.stack([SEEN[0], BEYOND[3]]))
    assert target.weight.tolist() == [1, 0, 0, 1]
    assert target.person.tolist() == [1, 1, 0, 0]
    assert torch.equal(target.background, BEYOND)


def objective_terms(
    settings: TrainingSettings, samples: RaySamples = SAMPLES, depths_m: Tensor | None = None, axis: int | None = None,
    unit_m: float = 1.0,
) -> dict[str, Tensor]:  # fmt: skip
    """Return the losses of the rays of test_losses, for a field with gamma 80; the rays start at z = 1 m and go down.
    depths_m: depths of the samples; axis: the vertical axis; unit_m: of the field's distances."""
    field: Any = torch.nn.Module()
    field.models_background, field.gamma, field.unit_m = True, 80.0, unit_m
    field.sample = lambda *inputs: (samples, depths_m)
    correction = PoseCorrection(frames=2, free_joints=0, shapes=2)
    correction.absorbed_shape.copy_(torch.tensor([3.0, 4.0]))
    origins_m, down = torch.tensor([[0.0, 0.0, 1.0]] * 2), torch.tensor([[0.0, 0.0, -1.0]] * 2)
    rays = PixelRays(origins_m, down, down[:, 0], TARGET.colour, TARGET.person > 0, TARGET.person > 0, None)
    objective = Objective(field, correction, settings, axis)
    return objective(PosedScene(None, None, None), rays, Draws(down, down, down))[0]


def test_each_loss_gets_its_own_inputs_and_weight() -> None:
    """Expect each of the ten values of test_losses times its weight."""
    s = LossSettings(
        **{"reconstruction": 2, "mask": 3, "blend": 5, "geometry": 7, "segmentation": 11, "eikonal": 13},
        **{"residual": 17, "fit": 19, "increment": 23, "elastic": 29, "eta": 0.25},
        geometry_roles="print",
    )
    expected = {
        "reconstruction": 2 * 0.475,
        "mask": 3 * 0.375,
        "blend": 5 * 1.025,
        "geometry": 7 * losses.geometry(SAMPLES, 50.0, 0.02, 80.0, "print").item(),
        "segmentation": 11 * losses.segmentation(SAMPLES.d_hat, TARGET, 80.0).item(),
        "eikonal": 13 * 0.145,
        "residual": 17 * 0.02,
        "fit": 19 * losses.segmentation(SAMPLES.d, TARGET, 80.0).item(),
        "increment": 23 * 5,
        "elastic": 29 * 0.1,
    }
    assert {name: term.item() for name, term in objective_terms(TrainingSettings(losses=s)).items()} == pytest.approx(
        expected, rel=1e-5
    )


def test_every_weight_has_a_loss() -> None:
    constants = {"eta", "density_threshold", "density_steepness", "geometry_roles"}
    weights = LossSettings.model_fields.keys() - constants
    settings = TrainingSettings(field=PaperFieldSettings(), losses=LossSettings(**dict.fromkeys(weights, 1)))
    samples = dataclasses.replace(SAMPLES, in_box=torch.ones(2, 2))
    assert objective_terms(settings, samples, torch.ones(2, 2), axis=2).keys() == weights


def test_the_floor_loss_covers_samples_below_the_ground() -> None:
    """The second sample of the first ray is 10 cm below the ground, and its d_hat is -0.02: a mean of 0.01 over two
    rays, times 3, and times 2.5 for a field whose distances are in units of 2.5 m. If the ground is unknown, there is
    no floor loss."""
    settings, depths_m = TrainingSettings(losses=LossSettings(floor=3)), torch.tensor([[0.9, 1.1], [0.5, 0.8]])
    known, unknown = (objective_terms(settings, depths_m=depths_m, axis=axis) for axis in (2, None))
    assert known["floor"].item() == pytest.approx(0.03)
    assert objective_terms(settings, SAMPLES, depths_m, 2, unit_m=2.5)["floor"].item() == pytest.approx(0.075)
    assert "floor" not in unknown


def test_the_fog_loss_covers_samples_in_the_box() -> None:
    settings = TrainingSettings(field=PaperFieldSettings(), losses=LossSettings(fog=31))
    terms = objective_terms(settings, dataclasses.replace(SAMPLES, in_box=torch.ones(2, 2)))
    assert terms["fog"].item() == pytest.approx(31 * 0.1)


def test_losses_with_zero_weight_are_not_computed() -> None:
    assert LossSettings().elastic == LossSettings().fog == 0
    terms = objective_terms(TrainingSettings(losses=LossSettings(mask=0, geometry=0)))
    assert not {"mask", "geometry", "elastic", "fog"} & terms.keys()

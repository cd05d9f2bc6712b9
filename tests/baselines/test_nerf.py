import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from hnerf.avatar.trained import build_field
from hnerf.baselines.box import BAND_M
from hnerf.baselines.nerf import NerfField
from hnerf.body.canonical import PosedBodies
from hnerf.config import load_settings
from hnerf.errors import InputError
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.rays import Rays
from hnerf.fields.samples import RaySamples
from hnerf.fields.shell import Boxes
from hnerf.training.losses import Target, blend, colour_errors
from tests.baselines.ball import RING, body, inner_psnr, psnr, record, trained

SMALL = [
    "training.steps=150",
    "training.rays_per_frame=96",
    "training.field.width=32",
    "training.field.samples=10",
    "training.field.learning_rate=0.02",
]


class Fog(torch.nn.Module):
    """A network with the same output everywhere."""

    def __init__(self, density: float, grey: float):
        super().__init__()
        self.outputs = density, grey

    def forward(self, point: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
        return torch.full_like(point[..., 0], self.outputs[0]), torch.full_like(point, self.outputs[1])


class Roomy(NerfField):
    margin_m = 1.5


@pytest.fixture
def fog() -> NerfField:
    """Return a field over the unit box with a margin of 1.5 m, so its half edge, the unit of densities, is 2 m. The
    coarse fog is thin and dark, the fine one dense and bright."""
    field = Roomy(body(), load_settings("nerf").training.field)
    field.coarse, field.fine = Fog(0.5, 0.25), Fog(2.0, 0.75)
    return field


def look(field: NerfField, draws: Draws) -> tuple[RaySamples, Tensor]:
    """Sample two rays: one through the middle of the box, 4 m of it inside, and one that misses it."""
    fit = body()
    bodies = PosedBodies(fit.rig, fit.theta, fit.root, field.canonical_m)
    conditions = Conditions.of(bodies, torch.zeros(1, dtype=torch.long), 2.5)
    origins = torch.tensor([[-3.0, 0.5, 0.5], [-3.0, 5.0, 0.5]])
    rays = Rays(origins, torch.tensor([[1.0, 0, 0]]).repeat(2, 1), torch.zeros(2, dtype=torch.long))
    return field.sample(field.scene(bodies, conditions), rays, draws)


def test_coarse_and_fine_colours_by_hand(fog: NerfField) -> None:
    """Samples lie at the start of strata of 4 m / 24, so both networks see the whole 4 m, or 2 units. Fine: 0.75 (1 -
    e^-4) + e^-4; coarse: 0.25 (1 - e^-1) + e^-1. The ray that misses the box sees white."""
    still = Draws.deterministic(2, 24, torch.device("cpu"))
    zero = torch.zeros(2, 24)
    samples, depths = look(fog, dataclasses.replace(still, jitter=zero, fine=zero))
    assert samples.alpha.shape == depths.shape == (2, 72)
    target = Target(torch.zeros(2, 3), torch.ones(2), torch.ones(2), background=torch.ones(2, 3))
    fine, coarse = 0.75 + 0.25 * math.exp(-4), 0.25 + 0.75 * math.exp(-1)
    assert colour_errors(samples, target).mean().item() == pytest.approx(3 * (fine + 1) / 2, abs=1e-4)
    assert blend(samples, target, 1.0).item() == pytest.approx(3 * (coarse + 1) / 2, abs=1e-4)
    assert depths[0, 0].item() == pytest.approx(1.5)  # the box starts at x = -1.5


def test_fine_samples_concentrate_where_the_coarse_network_has_density(fog: NerfField) -> None:
    """The coarse network has an opaque wall from 4.5 m on. The 24 fine samples lie in the cell where it begins, which
    extends half-way to the neighbouring samples, 4 m / 24 apart."""

    class Wall(Fog):
        def forward(self, point: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
            return 1e4 * (point[..., 0] > 0.5).float(), torch.zeros_like(point)  # x > 1.5 m

    fog.coarse = Wall(0, 0)
    _, depths = look(fog, Draws.deterministic(2, 24, torch.device("cpu")))
    first = 4.5 + 1 / 12  # the first coarse sample behind the wall's face
    assert ((depths[0, 24:] - first).abs() <= 1 / 12 + 1e-4).sum() >= 24


def test_the_surface_is_where_the_density_is_sigma_h(fog: NerfField) -> None:
    """With a half edge of 2 m, sigma_h is 40 per unit. The distance is 0 there, BAND_M in empty space and -BAND_M / 3
    at twice sigma_h."""
    fit = body()
    bodies = PosedBodies(fit.rig, fit.theta, fit.root, fog.canonical_m)
    conditions = Conditions.of(bodies, torch.zeros(1, dtype=torch.long), 2.5)
    for density, distance in ((40.0, 0.0), (0.0, BAND_M), (80.0, -BAND_M / 3)):
        fog.fine = Fog(density, 0)
        found = fog.signed_distance(bodies, torch.full((1, 3), 0.5), conditions)
        assert found.item() == pytest.approx(distance, abs=1e-7)
    outside = torch.tensor([[5.5, 5.5, 0.5]])  # 3 m beyond the box along x and y: the density does not count here
    assert fog.signed_distance(bodies, outside, conditions).item() == pytest.approx(3 * 2**0.5, rel=1e-6)


def test_distance_to_a_box_by_hand() -> None:
    """For a box of 2 m: 1 m deep at the centre, 0.25 m deep near a face, 1 m outside a face, sqrt(3) m from a
    corner."""
    boxes = Boxes(torch.full((1, 3), -1.0), torch.ones(1, 3))
    points = torch.tensor([[0.0, 0, 0], [0.75, 0, 0], [0, -2, 0], [2, 2, 2]])
    torch.testing.assert_close(boxes.signed_distance(points), torch.tensor([-1.0, -0.25, 1.0, 3**0.5]))


@pytest.mark.parametrize("method", ["NeRF", "IDR"])
def test_more_than_one_moment_is_refused(method: str) -> None:
    with pytest.raises(InputError, match=f"{method} models one moment"):
        build_field(load_settings(method.lower()).training.field, body(), static=False)


def test_overfits_the_ball(tmp_path: Path) -> None:
    """With eight views, a training view has 25 dB, and its colours are 5 dB better than a single colour."""
    avatar = trained(tmp_path, load_settings("nerf", SMALL).training, RING)
    assert psnr(avatar, tmp_path, "0") > 25
    colours, one_colour = inner_psnr(avatar, tmp_path, "0")
    assert colours > one_colour + 5


def test_visible_pixels_are_all_that_see_the_box(fog: NerfField, tmp_path: Path) -> None:
    """A camera 2 m from the centre of a box of 2 m sees its near side, 1 m away, in the whole image. A camera 12 m away
    sees the box in the middle of the image but not in the corner."""
    fog.margin_m = 0.5
    camera = record(tmp_path)[0].cameras["0"]
    vertices_m = body().vertices_m()[0].numpy()
    assert fog.visible_pixels(camera, vertices_m).all()
    away = dataclasses.replace(camera, t_m=camera.t_m + np.array([0, 0, 10.0]))
    visible_pixels = fog.visible_pixels(away, vertices_m)
    assert visible_pixels[len(visible_pixels) // 2, visible_pixels.shape[1] // 2] and not visible_pixels[0, 0]

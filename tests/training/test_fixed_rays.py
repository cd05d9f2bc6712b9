"""The PSNR on unseen frames: which pixels count, and what they are compared with."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from hnerf.fields.conditions import Draws
from hnerf.fields.rays import PosedScene
from hnerf.fields.samples import RaySamples
from hnerf.training.fixed_rays import FixedRays
from hnerf.training.pixels import PixelRays, Pixels


def sample(scene: PosedScene[Any], rays: PixelRays, draws: Draws) -> tuple[RaySamples, None]:
    """Return two opaque samples a ray: white outside the box, and behind it, in the box, a level of 102."""
    ones = torch.ones(len(rays), 2)
    in_box = torch.tensor([0.0, 1.0]).expand(len(rays), 2)
    colour = torch.tensor([[1.0] * 3, [102 / 255] * 3]).expand(len(rays), 2, 3)
    nothing = torch.zeros(len(rays), 2)
    return RaySamples(ones, ones, in_box, colour, None, ones, nothing, torch.zeros(0)), None


def psnr(levels: list[int], person: list[bool], edge: list[bool], models_background: bool) -> float | None:
    """Return the PSNR of a frame with pixels of these grey levels."""
    count = len(levels)
    pixels = Pixels(
        starts=torch.tensor([0, count]),
        image_starts=torch.tensor([0, count]),
        image_camera=torch.tensor([0]),
        pixel_index=None,
        cell=None,
        colour=torch.tensor(levels, dtype=torch.uint8)[:, None].expand(count, 3),
        plate=None,
        person=torch.tensor(person),
        edge=torch.tensor(edge),
        widths_px=torch.tensor([count]),
        rays_from_px=torch.eye(3)[None],
        centres_m=torch.zeros(1, 3),
    )
    field: Any = SimpleNamespace(
        training_samples=lambda _: (2, None), models_background=models_background, sample=sample
    )
    return FixedRays(field, pixels, 0, 1000).psnr(PosedScene(None, None, None), torch.tensor([0]))  # type: ignore[arg-type]


def test_the_psnr_is_that_of_the_person_away_from_outlines() -> None:
    """The person's pixel of 153 differs from 102 by 0.2: - 20 log10(0.2) dB. Their pixel at the outline, which also
    shows the background, and the background's do not count."""
    levels, person, edge = [153, 230, 0], [True, True, False], [False, True, False]
    assert psnr(levels, person, edge, models_background=False) == pytest.approx(13.979, abs=1e-3)


def test_outlines_count_for_a_field_with_its_own_background() -> None:
    """The person's only pixel, of 153, is at the outline."""
    levels, person, edge = [153, 0], [True, False], [True, False]
    assert psnr(levels, person, edge, models_background=True) == pytest.approx(13.979, abs=1e-3)
    assert psnr(levels, person, edge, models_background=False) is None

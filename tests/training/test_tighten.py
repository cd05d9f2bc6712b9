"""Thickness of the tightened shell on each side of the skin."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from hnerf.config import FastFieldSettings
from hnerf.fields.fast import FastField
from tests.body.boxes import box_rig

RIG = box_rig(splits=2)
SETTINGS = FastFieldSettings(
    outer_m=0.08, inner_m=0.06, shell_cell_m=0.05, geometry_cells=(2,), colour_cells=(2,), pose_width=1
)
SEEN_M = 0.005  # visible on either side of a surface with a logistic of 1000 per metre
ROOM_M = 0.012
STEP_M = 0.004  # of the search for the surface


def field_of(residual: Callable[[Tensor, Tensor], Tensor]) -> FastField:
    """Return a field with a given residual, a function of y (N, 3) and a pose (P,)."""
    field = FastField(RIG, SETTINGS, 1)
    field.log_sharpness.data.fill_(1000.0).log_()
    field.field.residual_in_each = lambda y, d, pose: (residual(y, one).expand(len(y)) for one in pose)
    return field


def tightened(residual: Callable[[Tensor, Tensor], Tensor], poses: list[float]) -> tuple[Tensor, Tensor]:
    """Return the tightened thickness outside and inside, at vertices inside the box's faces only: at its edges, points
    along a vertex normal have another closest point."""
    field = field_of(residual)
    field.tighten(RIG, torch.tensor(poses)[:, None].expand(-1, 3))
    within = ((RIG.vertices_m > 0.1) & (RIG.vertices_m < 0.9)).sum(1) == 2
    assert within.any()
    return field.outer_m[within], field.inner_m[within]


@pytest.mark.parametrize(
    ("surfaces_m", "outer_m", "inner_m"),
    [
        ([0.03], 0.03 + SEEN_M + ROOM_M, ROOM_M),  # nothing is visible inside
        ([-0.02], ROOM_M, 0.02 + SEEN_M + ROOM_M),
        ([0.03, -0.02], 0.03 + SEEN_M + ROOM_M, 0.02 + SEEN_M + ROOM_M),  # one surface in each of two poses
        ([0.075], 0.08, ROOM_M),  # never thicker than before
    ],
)
def test_each_side_is_as_thick_as_its_visible_surface_needs(
    surfaces_m: list[float], outer_m: float, inner_m: float
) -> None:
    """In each pose, the surface is at a given height above the skin."""
    outer, inner = tightened(lambda y, pose: -pose[0], surfaces_m)
    assert ((outer - outer_m).abs() <= STEP_M + 1e-6).all()
    assert ((inner - inner_m).abs() <= STEP_M + 1e-6).all()


def test_each_vertex_is_tightened_to_the_surface_visible_there() -> None:
    """The surface is 4 cm outside the skin in the upper half of the body, and at the skin in the lower half."""
    field = field_of(lambda y, pose: torch.where(y[:, 2] > 0.5, -0.04, 0.0))
    field.tighten(RIG, torch.zeros(1, 3))
    x, y, z = RIG.vertices_m.T
    side = ((x - 0.5).abs() == 0.5) & (y > 0.1) & (y < 0.9)
    above, below = (field.outer_m[side & height] for height in ((z > 0.6) & (z < 0.9), (z > 0.1) & (z < 0.4)))
    assert (above - 0.04 - SEEN_M - ROOM_M).abs().max() <= STEP_M + 1e-6
    assert (below - SEEN_M - ROOM_M).abs().max() <= STEP_M + 1e-6

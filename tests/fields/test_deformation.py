"""Per-frame deformation: nodes and their weights by hand, gradients in double precision, and a moving surface."""

import numpy as np
import pytest
import torch
from torch import nn

from hnerf.body.canonical import Descriptor, PosedBodies
from hnerf.config import FastFieldSettings
from hnerf.fields.conditions import Conditions
from hnerf.fields.deformation import FrameDeformation, farthest_points
from hnerf.fields.fast import FastField
from tests.body.boxes import box_rig

RIG = box_rig()
CENTIMETRES = torch.tensor([[0.01, 0.0, 0.0], [0.0, 0.0, 0.02]])


def at(corners: list[int], barycentric: list[float]) -> Descriptor:
    """Return the descriptor of a point next to a triangle of the box."""
    nowhere, corner = torch.zeros(1, 3), torch.tensor([corners])
    return Descriptor(torch.zeros(1), nowhere, nowhere, torch.ones(1).bool(), corner, torch.tensor([barycentric]))


def deformation(nodes: int) -> FrameDeformation:
    found = FrameDeformation(RIG.vertices_m, RIG.faces, nodes, frames=2)
    found.displacement.data[:2] = CENTIMETRES[:, None]
    return found


def test_farthest_point_sampling_by_hand():
    """On a line, starting at 0: 10 is farthest, then 4 (4 from 0 and 6 from 10), then 7 (3 from 4 and from 10)."""
    line = np.array([0.0, 1.0, 4.0, 7.0, 10.0])[:, None]
    assert farthest_points(line, 4) == [0, 4, 2, 3]


def test_a_single_node_moves_all_points_in_a_frame_and_none_without_a_frame():
    moments = torch.tensor([0, 1, -1])
    described = at([4, 5, 6], [0.5, 0.25, 0.25])
    moved = torch.cat([deformation(1)(described, m[None])[0] for m in moments])
    torch.testing.assert_close(moved, torch.cat([CENTIMETRES, torch.zeros(1, 3)]))


@pytest.mark.parametrize("size_m", [1.0, 2.0])
def test_node_weights_by_hand(size_m: float):
    """The nodes are the opposite corners 0 and 6. All corners are within 1 of one of them, so nodes have a reach of
    0.5. Corner 1, at 1 from node 0 and sqrt(2) from node 6, follows node 0 with weight 1 / (1 + exp((1 - 2) / 0.25)),
    whatever the unit."""
    found = FrameDeformation(size_m * RIG.vertices_m, RIG.faces, 2, frames=1)
    found.displacement.data[0, 0] = torch.tensor([1.0, 0.0, 0.0])
    moved, normal_displacement = found(at([1, 1, 1], [0.2, 0.3, 0.5]), torch.tensor([0]))
    share = 1 / (1 + torch.exp(torch.tensor(-1 / 0.25)))
    torch.testing.assert_close(moved, torch.tensor([[share, 0.0, 0.0]]))
    torch.testing.assert_close(normal_displacement, share * found.normals[1, :1])


def test_gradients_match_finite_differences():
    found = deformation(3).double()
    described = at([4, 5, 6], [0.5, 0.25, 0.25])
    described = Descriptor(*(v.double() if v.is_floating_point() else v for v in vars(described).values()))

    def moved(displacement: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.func.functional_call(found, {"displacement": displacement}, (described, torch.tensor([1])))

    assert torch.autograd.gradcheck(moved, found.displacement.detach().requires_grad_())


def test_poses_without_a_frame_get_the_mean_displacement_of_frames():
    """Frames 0 and 2 move by 1 cm along x and by 2 cm upwards, so frame 1 and poses of no frame move by 0.5 cm and 1
    cm."""
    found = FrameDeformation(RIG.vertices_m, RIG.faces, 2, frames=3)
    found.displacement.data[[0, 2]] = CENTIMETRES[:, None]
    found.average_over_frames(torch.tensor([0, 2]))
    mean = torch.tensor([0.005, 0.0, 0.01])
    expected = torch.stack([CENTIMETRES[0], mean, CENTIMETRES[1], mean])[:, None].expand(-1, 2, -1)
    torch.testing.assert_close(found.displacement.data, expected)


def test_displacement_along_vertex_normals():
    """In frame 0 all vertices move 1 cm along x: corner 0, at the origin, moves inwards, corner 1, at (1, 0, 0),
    outwards. In frame 1 all move 2 cm up, so corner 1 moves inwards."""
    found = deformation(1)
    across, up, nowhere = found.normal_displacement(torch.tensor([0, 1, -1]))
    torch.testing.assert_close(across, 0.01 * found.normals[:, 0])
    assert across[0] < -0.003 and across[1] > 0.003 and up[1] < -0.003
    assert (nowhere == 0).all()


@pytest.mark.parametrize("moved_m", [[0.0, 0.0, 0.02], [0.015, -0.01, 0.0]])
def test_a_frames_displacement_moves_distance_and_colour(moved_m: list[float]):
    """In frame 1 a box is displaced by m, along the normal or across it. At x + m it has the distance (with any
    residual) and the colour that it has at x in frame 0 and in a pose of no frame."""
    torch.manual_seed(0)
    settings = FastFieldSettings(
        outer_m=0.1, inner_m=0.1, geometry_cells=(16,), colour_cells=(16,), pose_width=1, nodes=1
    )
    rig = box_rig(splits=3)
    field = FastField(rig, settings, frames=2)
    assert field.deformation is not None
    field.deformation.displacement.data[1] = torch.tensor(moved_m)
    nn.init.normal_(field.field.geometry[-1].weight)
    nn.init.normal_(field.field.geometry_grids.features)
    bodies = PosedBodies(rig, torch.zeros(1, 2, 3), torch.eye(4)[None], rig.vertices_m)
    points_m = torch.tensor([[0.43, 0.51, 1.03], [0.55, 0.38, 1.01]])

    def seen(at_m: torch.Tensor, moment: int) -> torch.Tensor:
        known = Conditions.of(bodies, torch.tensor([moment]), 2.5)
        distance_m = field.signed_distance(bodies, at_m, known)
        return torch.cat([distance_m[:, None], field.colour(bodies, at_m, at_m, known)], 1)

    torch.testing.assert_close(seen(points_m + torch.tensor(moved_m), 1), seen(points_m, 0), atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(seen(points_m, -1), seen(points_m, 0))
    assert (seen(points_m, 1) - seen(points_m, 0)).abs().max() > 1e-3
    moved = field.frame_displacements(bodies, points_m, torch.tensor([1, -1, 0]))
    torch.testing.assert_close(moved, torch.tensor([moved_m, [0.0] * 3, [0.0] * 3])[:, None].expand(-1, 2, -1))


def test_frame_displacements_are_relative_to_the_mean_over_frames():
    """The surface moves by 2 and by 4 cm in frames 0 and 1, and by 3 cm in poses of no frame."""
    settings = FastFieldSettings(outer_m=0.1, inner_m=0.1, geometry_cells=(16,), colour_cells=(16,), nodes=1)
    rig = box_rig(splits=3)
    field = FastField(rig, settings, frames=2)
    assert field.deformation is not None
    field.deformation.displacement.data[:2, 0, 0] = torch.tensor([0.02, 0.04])
    field.average_over_frames(torch.tensor([0, 1]))
    bodies = PosedBodies(rig, torch.zeros(1, 2, 3), torch.eye(4)[None], rig.vertices_m)
    moved = field.frame_displacements(bodies, torch.tensor([[0.43, 0.51, 1.03]]), torch.tensor([0, 1, -1]))
    torch.testing.assert_close(moved[:, 0], torch.tensor([[-0.01, 0, 0], [0.01, 0, 0], [0.0, 0, 0]]))

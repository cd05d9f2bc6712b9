"""The inputs of the fast field's two networks at a point, and the units of their outputs, by hand."""

import torch
from torch import Tensor, nn

from hnerf.config import FastFieldSettings
from hnerf.fields.grids import CanonicalField
from tests.fields.plain_grids import everywhere

SETTINGS = FastFieldSettings(outer_m=0.05, geometry_cells=(1, 2), colour_cells=(1,), channels=1, width=4, pose_width=2)
Y, D = torch.tensor([[0.2, 0.3, 0.4]]), torch.tensor([-0.01])
NORMAL = torch.tensor([[1.0, 0.0, -0.5]])
POSE = torch.tensor([[7.0, 8.0, 9.0], [0.1, 0.2, 0.3]]), torch.tensor([1])  # two poses, and the row of each point
CODE = [0.3, -0.2]  # code of this row's pose: its third number, and minus its second


class First(nn.Module):
    """Network that returns its first inputs."""

    def __init__(self, outputs: int):
        super().__init__()
        self.outputs, self.asked = outputs, torch.empty(0)

    def forward(self, inputs: Tensor) -> Tensor:
        self.asked = inputs.detach()
        return inputs[:, : self.outputs]


def known_field() -> CanonicalField:
    """Return a field with geometry features 0.5 and 0.25 and colour feature 2 everywhere."""
    field = CanonicalField(torch.zeros(3), torch.ones(3), SETTINGS, 3, everywhere)
    for grids, features in ((field.geometry_grids, (0.5, 0.25)), (field.colour_grids, (2.0,))):
        levels = zip(grids.dense_levels(), features, strict=True)
        grids.set_levels([torch.full_like(level, feature) for level, feature in levels])
    field.pose_code.weight.data = torch.tensor([[0.0, 0, 1], [0, -1, 0]])
    field.geometry = nn.Sequential(First(1), nn.Identity(), nn.Identity())
    field.radiance = nn.Sequential(First(3))
    return field


def test_inputs_of_the_geometry_network() -> None:
    """The network sees features, distance and pose code. Input distance and output are in units of the outer shell
    thickness: half of 5 cm."""
    field = known_field()
    found = field.residual(Y, D, *POSE)
    torch.testing.assert_close(field.geometry[0].asked, torch.tensor([[0.5, 0.25, -0.2, *CODE]]))
    torch.testing.assert_close(found.detach(), torch.tensor([0.025]))


def test_inputs_of_the_colour_network() -> None:
    """The network sees features, distance, pose code and normal. The normal is encoded with one octave: sines of pi, 0
    and -pi / 2, and their cosines."""
    field = known_field()
    found = field.colour(Y, D, NORMAL, *POSE)
    encoded = [1.0, 0, -0.5, 0, 0, -1, -1, 1, 0]
    torch.testing.assert_close(field.radiance[0].asked, torch.tensor([[2.0, -0.2, *CODE, *encoded]]), atol=1e-6, rtol=0)
    torch.testing.assert_close(found.detach(), torch.sigmoid(torch.tensor([[2.0, -0.2, 0.3]])))


def random_field() -> CanonicalField:
    torch.manual_seed(0)
    field = CanonicalField(torch.zeros(3), torch.ones(3), SETTINGS, 3, everywhere)
    for parameter in field.parameters():
        nn.init.normal_(parameter)
    return field


def test_results_do_not_depend_on_other_poses_in_the_batch() -> None:
    field, (poses, row) = random_field(), POSE
    alone = poses[1:], torch.zeros(1, dtype=torch.long)
    torch.testing.assert_close(field.residual(Y, D, *alone), field.residual(Y, D, poses, row))
    torch.testing.assert_close(field.colour(Y, D, NORMAL, *alone), field.colour(Y, D, NORMAL, poses, row))


def test_residual_in_each_pose_matches_single_poses() -> None:
    field, poses = random_field(), POSE[0]
    each = [field.residual(Y, D, poses, torch.tensor([k])) for k in range(2)]
    torch.testing.assert_close(list(field.residual_in_each(Y, D, poses)), each)
    assert (each[0] - each[1]).abs() > 1e-3


def test_the_residual_is_zero_before_training_and_depends_on_all_inputs_after() -> None:
    """The surface starts as the body's own. With random weights, the residual changes with position, distance and
    pose."""
    torch.manual_seed(0)
    field = CanonicalField(torch.zeros(3), torch.ones(3), SETTINGS, 3, everywhere)
    assert field.residual(Y, D, *POSE).item() == 0
    nn.init.normal_(field.geometry[-1].weight)
    nn.init.normal_(field.geometry_grids.features)
    here = field.residual(Y, D, *POSE)
    poses, row = POSE
    for changed in ((Y + 0.1, D, *POSE), (Y, D + 0.01, *POSE), (Y, D, poses + 0.1, row)):
        assert (field.residual(*changed) - here).abs() > 1e-6

import dataclasses

import torch

from hnerf.asset.rig_transfer import strongest, transfer_skin_weights, with_vertices
from tests.asset.figure import column_rig, upper_weight, upright_column


def test_skinning_weights_come_from_the_closest_point_of_the_body() -> None:
    rig = column_rig()
    sleeve = upright_column(0.18, 0.1, 1.5, storeys=36)
    vertices_m, faces = torch.from_numpy(sleeve.vertices).float(), torch.from_numpy(sleeve.faces).long()
    joints, weights = transfer_skin_weights(rig, vertices_m, faces)
    upper = torch.where(joints == 1, weights, 0.0).sum(1)
    torch.testing.assert_close(weights.sum(1), torch.ones(len(weights)))
    z_m = vertices_m[:, 2]
    assert (upper - upper_weight(z_m)).abs().max() < 0.1  # smoothing rounds both ends of the ramp
    far = (z_m - 0.8).abs() > 0.3
    torch.testing.assert_close(upper[far], (z_m[far] > 0.8).float())
    assert (upper[(z_m - 0.8).abs() < 1e-3] - 0.5).abs().max() < 0.03


def test_at_most_eight_influences_largest_first() -> None:
    rig = column_rig()
    vertices = len(rig.vertices_m)
    parts = torch.arange(1.0, 11.0)  # every vertex has ten joints with weights 1/55 to 10/55
    ten = dataclasses.replace(
        rig,
        joints_m=torch.zeros(10, 3),
        skin_joints=torch.arange(10).repeat(vertices, 1),
        skin_weights=(parts / parts.sum()).repeat(vertices, 1),
    )
    joints, weights = transfer_skin_weights(ten, rig.vertices_m, rig.faces)
    assert joints[0].tolist() == [9, 8, 7, 6, 5, 4, 3, 2]
    torch.testing.assert_close(weights[0], torch.arange(10.0, 2.0, -1) / 52)  # 10 + 9 + ... + 3 = 52


def test_influences_of_zero_weight_point_to_the_first_joint() -> None:
    joints, weights = strongest(torch.tensor([[0.1, 0.0, 0.4, 0.0]]))
    assert joints.tolist() == [[2, 0, 0, 0]]
    torch.testing.assert_close(weights, torch.tensor([[0.8, 0.2, 0, 0]]))


def test_an_eye_joint_moves_to_the_centre_of_its_eyeball() -> None:
    """The vertices that follow the upper joint, at 0.8 m, stand in for the eyeball: 30 cm wide and from 0.9 to 1.6 m
    high. They move by 2 cm."""
    rig = dataclasses.replace(column_rig(), joint_names=("root", "eye.L"))
    on_eye = upper_weight(rig.vertices_m[:, 2]) > 0.999
    moved_m = torch.where(on_eye[:, None], torch.tensor([0.0, 0.02, 0]), torch.ones(3))
    moved = with_vertices(rig, rig.vertices_m + moved_m)
    lowest_m = float(rig.vertices_m[on_eye, 2].min())
    torch.testing.assert_close(moved.joints_m, torch.tensor([[0.0, 0, 0], [0, 0.02, (lowest_m + 1.6) / 2]]))
    assert moved.vertices_m.equal(rig.vertices_m + moved_m)
    torch.testing.assert_close(with_vertices(column_rig(), moved.vertices_m).joints_m, column_rig().joints_m)

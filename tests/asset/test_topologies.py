import dataclasses

import numpy as np
import torch
import trimesh

from hnerf.asset.correctives import as_they_are
from hnerf.asset.registration import crossing_faces
from hnerf.asset.rig_transfer import clothed_rig
from hnerf.asset.topologies import AssetMesh, registered_mesh
from tests.asset.figure import column_rig, twice, upper_weight, upright_column


def test_a_moved_mesh_does_not_cross_itself() -> None:
    """Of two boxes 3 mm apart, one should move by 3.5 mm towards the other. Its vertices that would cross move only
    half as far."""
    boxes = twice(trimesh.creation.box(extents=(0.02, 0.02, 0.02)), (0.023, 0.001, 0.001))
    mesh = AssetMesh(clothed_rig(column_rig(), boxes), as_they_are, len(boxes.faces), None)
    offsets_m = np.zeros((16, 3), np.float32)
    offsets_m[8:, 0] = -0.0035
    moved = mesh.moved(offsets_m).trimesh
    assert not crossing_faces(moved.vertices, moved.faces).any()
    np.testing.assert_allclose((moved.vertices - boxes.vertices)[:, 0].min(), -0.0035, atol=1e-6)
    facing = moved.vertices[8:, 0] < 0.02
    np.testing.assert_allclose(moved.vertices[8:, 0][facing], 0.013 - 0.00175, atol=1e-6)


def test_eyeballs_and_eye_joints_move_with_the_registered_mesh() -> None:
    """The field stands 2 cm to the left of the body. The vertices that follow the upper joint stand in for an eyeball,
    and move there too."""
    rig = dataclasses.replace(column_rig(), joint_names=("root", "eye.L"))
    field = upright_column(0.15, 0.0, 1.6)
    field.vertices += (0.02, 0, 0)
    shown = registered_mesh(rig, field).rig
    ball_m = shown.vertices_m[upper_weight(rig.vertices_m[:, 2]) > 0.999]
    middle_m = (ball_m.amin(0) + ball_m.amax(0)) / 2
    assert 0.005 < float(middle_m[0]) < 0.02
    torch.testing.assert_close(shown.joints_m, torch.stack([torch.zeros(3), middle_m]))

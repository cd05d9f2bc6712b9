"""A body small enough to pose by hand: two unit bones along z, a locked tip, five vertices."""

import torch

from hnerf.body.rig import Rig


def two_bone_rig() -> Rig:
    """Return the rig with joints at z = 0 (root), 1 (elbow, free) and 2 (tip, locked).

    Vertices: v0 follows the root, v1 root and elbow by half each, v2 the elbow, v3 and v4 the tip. beta lengthens the
    upper bone: everything from v2 on moves up.
    """
    vertices = torch.tensor([[0.1, 0, 0.5], [0.1, 0, 1.0], [0.0, 0, 1.5], [0.0, 0, 2.5], [0.1, 0, 2.5]])
    shape = torch.zeros(1, 5, 3)
    shape[0, 2:, 2] = 1.0
    joint_shape = torch.zeros(1, 3, 3)
    joint_shape[0, 1:, 2] = 1.0
    keypoints = torch.zeros(25, 5)
    keypoints[torch.arange(25), torch.arange(25) % 5] = 1.0
    return Rig(
        vertices_m=vertices,
        faces=torch.tensor([[0, 1, 2], [1, 2, 3], [2, 3, 4]]),
        joints_m=torch.tensor([[0.0, 0, 0], [0, 0, 1], [0, 0, 2]]),
        joint_names=("root", "elbow", "tip"),
        parents=torch.tensor([-1, 0, 1]),
        beta=torch.tensor([0.3]),
        beta_names=("length",),
        shape_basis=shape,
        joint_basis=joint_shape,
        skin_joints=torch.tensor([[0, 0], [0, 1], [1, 1], [2, 2], [2, 2]]),
        skin_weights=torch.tensor([[1.0, 0], [0.5, 0.5], [1.0, 0], [1.0, 0], [1.0, 0]]),
        free=torch.tensor([False, True, False]),
        keypoint_weights=keypoints,
    ).to(dtype=torch.float64)

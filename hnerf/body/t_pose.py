"""The T pose of a rig, in which other programs compare skeletons."""

import torch
from jaxtyping import Float
from torch import Tensor

from hnerf.body.canonical import axis_angle_from_rotation
from hnerf.body.rig import Rig, shortest_rotation

OUT, DOWN = (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)  # in the body frame, of the left side
# Joints that turn, the joint at the end of their bone, and where it then points.
BONES = {
    "upperarm01": ("lowerarm01", OUT),
    "lowerarm01": ("wrist", OUT),
    "wrist": ("finger3-1", OUT),
    "upperleg01": ("lowerleg01", DOWN),
    "lowerleg01": ("foot", DOWN),
}


def t_pose(rig: Rig) -> Float[Tensor, "J 3"]:
    """Return theta (J, 3) with arms and hands straight out to the sides, and legs straight down. Bones take the
    shortest rotation, which also decides where palms face; feet, trunk and head keep their directions, fingers stay at
    rest.
    """
    names, joints_m = rig.joint_names, rig.joints_m.double()
    turns: list[Tensor] = []  # of each joint, in the body frame
    local = torch.zeros(len(names), 3, 3, dtype=torch.float64)
    for j, (name, parent) in enumerate(zip(names, rig.parents.tolist(), strict=True)):
        bone, _, side = name.partition(".")
        above = turns[parent] if parent >= 0 else torch.eye(3, dtype=torch.float64)
        end, direction = BONES.get(bone, ("", OUT))
        if (tip := f"{end}.{side}") in names:
            mirror = torch.tensor([1.0 if side == "L" else -1.0, 1, 1], dtype=torch.float64)
            along_m = joints_m[names.index(tip)] - joints_m[j]
            turns.append(shortest_rotation(along_m, mirror * torch.tensor(direction, dtype=torch.float64)))
        else:
            turns.append(torch.eye(3, dtype=torch.float64) if bone == "foot" else above)
        local[j] = above.T @ turns[j]
    return axis_angle_from_rotation(local).to(rig.joints_m.dtype)

"""A walk on a small circle, composed of sine waves, so that no recorded motion is needed."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from hnerf.body.rig import Rig

STEP_CYCLE_S = 1.15  # of two steps
TURN_DEGPS = 80.0
CIRCLE_RADIUS_M = 0.2


@dataclass(frozen=True)
class WalkPose:
    """One pose of the walk: theta (J, 3) radians and root (4, 4) world from body, as in Rig; `gait_phase` in
    radians."""

    theta: Tensor
    root: Tensor
    gait_phase: float


def walk_pose(rig: Rig, time_s: float, waving: float) -> WalkPose:
    """Return the pose at a time. `waving` 0 is a plain walk; 1 raises the left hand, bends the right arm and leans
    forward.

    In the body frame (Z up, facing -Y, left is +X) a turn about +X swings a hanging limb backwards.
    """
    phase = 2 * np.pi * time_s / STEP_CYCLE_S
    theta = torch.zeros(len(rig.joint_names), 3)
    for name, rotation in _joint_rotations(phase, waving).items():
        theta[rig.joint_names.index(name)] = torch.from_numpy(rotation.as_rotvec())
    heading = np.radians(TURN_DEGPS) * time_s
    root = torch.eye(4)
    root[:3, :3] = torch.from_numpy(Rotation.from_euler("z", heading).as_matrix())
    root[:2, 3] = -CIRCLE_RADIUS_M * torch.tensor([np.cos(heading), np.sin(heading)])
    return WalkPose(theta, root, phase)


def _joint_rotations(phase: float, waving: float) -> dict[str, Rotation]:
    """Return the rotation of each joint that moves, by name."""
    rotations = {
        "spine03": _about(x=4 + 10 * waving, z=4 * np.sin(phase)),
        "spine01": _about(y=2 * np.cos(phase), z=4 * np.sin(phase)),
        "head": _about(x=-3 - 6 * waving, z=-8 * np.sin(phase)),
    }
    for side, sign in (("L", 1), ("R", -1)):
        swing = np.sin(phase) * sign
        lift = max(0.0, np.cos(phase) * sign) ** 2  # the leg goes forward while it is lifted
        hip_deg, knee_deg = -26 * swing - 10 * lift, 6 + 48 * lift
        rotations[f"upperleg01.{side}"] = _about(x=hip_deg, y=4 * sign)
        rotations[f"lowerleg01.{side}"] = _about(x=knee_deg)
        rotations[f"foot.{side}"] = _about(x=-0.5 * (hip_deg + knee_deg) + 8 * lift)
        raised = waving if side == "L" else 0.0
        lowered = _about(y=sign * (24 - 110 * raised))  # from the rest pose, whose arms are 45 degrees out
        rotations[f"upperarm01.{side}"] = _about(x=24 * swing * (1 - raised) - 20 * waving) * lowered
        elbow_deg = -10 + 14 * swing - (60 if side == "R" else 25) * waving
        # A hinge across the lowered arm, written in the rest pose's axes.
        rotations[f"lowerarm01.{side}"] = lowered.inv() * _about(x=elbow_deg) * lowered
    return rotations


def _about(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Rotation:
    """Return a rotation by degrees about the body frame's axes: first y, then x, then z."""
    return Rotation.from_euler("yxz", [y, x, z], degrees=True)

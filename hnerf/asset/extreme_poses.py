"""Shapes that show how well an asset deforms: extreme poses, expressions, and other physiques."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from hnerf.asset.motions import motion_of
from hnerf.asset.registration import crossing_faces
from hnerf.asset.rigs import FULL, posed_frames
from hnerf.asset.skinning import skinned
from hnerf.asset.staging import StagedAvatar
from hnerf.body.fingers import LIMITS_DEG, FingerPrior
from hnerf.body.fit_result import BodyFit
from hnerf.body.hand_points import finger_joints
from hnerf.body.rig import Rig
from hnerf.geometry.axes import Y_UP_FROM_Z_UP
from hnerf.side_by_side import side_by_side

# Joint rotations from the A pose, in degrees: about X (to the left), then Y (up), then Z (to the front). The right side
# mirrors the left. They are near the limits of human motion.
ARMS_UP = {"clavicle.L": (0, 0, 20), "upperarm01.L": (0, 0, 100)}
DEEP_SQUAT = {"spine05": (20, 0, 0), "spine03": (10, 0, 0), "upperleg01.L": (-110, 20, 0), "lowerleg01.L": (130, 0, 0),
              "foot.L": (-25, 0, 0), "upperarm01.L": (-40, 0, 0)}  # fmt: skip
TURNED_HEAD = {"neck01": (0, 20, 0), "neck02": (0, 15, 0), "neck03": (0, 15, 0), "head": (0, 20, 0)}
FIST_DEG = (20.0, 35.0, 45.0, *4 * (80.0, 95.0, 60.0))  # flexion of segments from straight: the thumb's, then fingers'
HAND = ("wrist.L", "metacarpal", "finger")  # prefixes of joint names
HEAD = ("head", "neck", "eye")
EXPRESSIONS = {
    "Jaw open": ("jawOpen",),
    "Smile": ("mouthSmileLeft", "mouthSmileRight"),
    "Eyes closed": ("eyeBlinkLeft", "eyeBlinkRight"),
    "Brows up": ("browInnerUp", "browOuterUpLeft", "browOuterUpRight"),
}


@dataclass(frozen=True)
class ExtremePose:
    """A pose of the asset, or its rest pose in another shape. points_m (V, 3), Y up, facing +Z; shown (V,) bool: the
    points that an image frames; crossing: the share of the skin's faces that cross others."""

    name: str
    points_m: np.ndarray
    shown: np.ndarray
    crossing: float


def extreme_poses(staged: StagedAvatar, rig: Rig, skin_faces: int) -> list[ExtremePose]:
    """Return the poses for which the rig has joints and the mesh has points to frame (a captured one may lack hands),
    and the asset's expressions and physiques. rig: the asset's, in body axes; skin_faces: how many of its first faces
    are closed skin."""
    everything = np.ones(len(rig.vertices_m), bool)
    poses = {
        "Arms up": (turned(rig, ARMS_UP), everything),
        "Deep squat": (turned(rig, DEEP_SQUAT), everything),
        "Fist": (fist(rig), moved_by(rig, HAND) & (rig.vertices_m[:, 0] > 0).numpy()),
        "Turned head": (turned(rig, TURNED_HEAD), moved_by(rig, HEAD)),
    }
    surfaces = {n: (posed_m(staged, rig, theta), shown) for n, (theta, shown) in poses.items() if theta is not None}
    surfaces |= with_expressions(staged)
    bodies_m = {name: staged.rest_points_m + moved_m for name, moved_m in staged.physiques_m.items()}
    surfaces |= {name.capitalize(): (points_m, everything) for name, points_m in bodies_m.items()}

    def measured(name: str) -> ExtremePose:
        points_m, shown = surfaces[name]
        return ExtremePose(name, points_m, shown, float(crossing_faces(points_m, staged.faces[:skin_faces]).mean()))

    return list(side_by_side(measured, [name for name, (_, shown) in surfaces.items() if shown.any()]))


def with_expressions(staged: StagedAvatar) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return, by name, the surface at rest (V, 3) with each of `EXPRESSIONS`, and which points belong to the face, (V,)
    bool. Empty if the asset has no expressions."""
    units = staged.expressions_m
    if not units:
        return {}
    face = np.any([moved_m.any(1) for moved_m in units.values()], 0)
    moved_m = {name: np.sum([units[unit] for unit in parts], 0) for name, parts in EXPRESSIONS.items()}
    return {name: (staged.rest_points_m + m, face) for name, m in moved_m.items()}


def turned(rig: Rig, turns_deg: Mapping[str, tuple[float, float, float]]) -> Tensor | None:
    """Return the pose (J, 3), axis-angle in body axes, of rotations in stage axes, mirrored to the right side; None if
    the rig lacks a joint."""
    mirrored = {f"{name[:-1]}R": (x, -y, -z) for name, (x, y, z) in turns_deg.items() if name.endswith(".L")}
    both = {**turns_deg, **mirrored}
    if not set(both) <= set(rig.joint_names):
        return None
    theta = torch.zeros(len(rig.joint_names), 3)
    for name, angles_deg in both.items():
        vector = Rotation.from_euler("xyz", angles_deg, degrees=True).as_rotvec() @ Y_UP_FROM_Z_UP
        theta[rig.joint_names.index(name)] = torch.from_numpy(vector)
    return theta


def fist(rig: Rig) -> Tensor | None:
    """Return the pose (J, 3) with both hands closed; None if the rig lacks a joint of a finger."""
    if not {"wrist.L", "wrist.R", *finger_joints()} <= set(rig.joint_names):
        return None
    prior = FingerPrior.of(rig)
    straight = prior.low[:, 0] - math.radians(LIMITS_DEG[0])
    flexion = straight + torch.deg2rad(torch.tensor(FIST_DEG * 2))
    theta = torch.zeros(len(rig.joint_names), 3)
    theta[[rig.joint_names.index(name) for name in finger_joints()]] = (flexion[:, None] * prior.axes[:, 0]).float()
    return theta


def moved_by(rig: Rig, names: tuple[str, ...]) -> np.ndarray:
    """Return which vertices (V,) bool have their largest weight on a joint whose name starts with one of `names`."""
    joints = [j for j, joint in enumerate(rig.joint_names) if joint.startswith(names)]
    most = rig.skin_joints.gather(1, rig.skin_weights.argmax(1, keepdim=True))[:, 0]
    return np.isin(most.numpy(), joints)


def posed_m(staged: StagedAvatar, rig: Rig, theta: Tensor) -> np.ndarray:
    """Return the surface (V, 3) of the full rig in a pose theta (J, 3), without correctives, in stage axes."""
    full, shapes = staged.rigs[FULL], len(staged.shapes_m)
    body = BodyFit(rig, (0,), theta[None], torch.eye(4)[None])
    motion = motion_of(body, 1.0, np.zeros((1, shapes), np.float32), Y_UP_FROM_Z_UP)
    turned = motion.transforms(rig.parents.numpy(), full.skeleton.positions_m[1:])
    stage = full.skeleton.posed(turned, np.eye(4)[None])
    transforms, points_m = next(posed_frames(full.skeleton, stage, staged.rest, motion.shape_weights))
    return skinned(transforms, full.skin, points_m)

"""The clothed avatar in the axes of asset formats: right-handed, Y up, metres; shared by the USD and glTF writers."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hnerf.asset.correctives import Correctives
from hnerf.asset.texture import UvLayout
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import joint_transforms

Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # (x, y, z) to (x, z, -y)


@dataclass(frozen=True)
class StagedAvatar:
    """The arrays of an avatar ready to be written; numpy, float64 and int64 unless said otherwise.

    rest_points_m (V, 3), faces (F, 3), uvs (U, 2) v up, face_uvs (F, 3), skin_joints and skin_weights (V, K): the mesh.
    joint_names, parents (J,), rest_joints_m (J, 3): the skeleton, whose rest orientations are the identity. frames
    (n,), translations_m (n, J, 3), quaternions (n, J, 4) as x y z w without sign jumps: the motion, each joint relative
    to its parent, the root relative to the stage. points_m (n, V, 3) float32: the surface of each frame. shapes_m
    (K, V, 3), shape_weights (n, K) float32: corrective blend shapes, applied before the skin. texture (H, W, 3) uint8
    sRGB. stage_from_world (3, 3): a rotation.
    """

    rest_points_m: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray
    face_uvs: np.ndarray
    skin_joints: np.ndarray
    skin_weights: np.ndarray
    joint_names: tuple[str, ...]
    parents: np.ndarray
    rest_joints_m: np.ndarray
    frames: np.ndarray
    translations_m: np.ndarray
    quaternions: np.ndarray
    points_m: np.ndarray
    shapes_m: np.ndarray
    shape_weights: np.ndarray
    texture: np.ndarray
    stage_from_world: np.ndarray

    @property
    def rest_offsets_m(self) -> np.ndarray:
        """Return the rest joints relative to their parents, (J, 3)."""
        above = np.where(self.parents[:, None] >= 0, self.rest_joints_m[self.parents], 0)
        return self.rest_joints_m - above


def stage_avatar(
    clothed: BodyFit, surfaces_m: np.ndarray, correctives: Correctives, layout: UvLayout, texture: np.ndarray, up: str
) -> StagedAvatar:
    """Turn a clothed body (see `clothed_rig`) and its motion to Y up. surfaces_m (n, V, 3): its surface in each frame;
    `up`: the vertical axis of the world, "y" or "z".

    The body frame is Z up whatever the world is. With W stage from world, B stage from body and G_j the world transform
    of joint j, the joint's stage transform is W G_j B^-1, and B G_parent^-1 G_j B^-1 relative to its parent.
    """
    rig, body = clothed.rig, Y_UP_FROM_Z_UP
    world = stage_from_world(up)
    transforms = joint_transforms(rig.to(dtype=torch.float64), clothed.theta.double(), clothed.root.double()).numpy()
    staged = _rotation_4x4(world) @ transforms @ _rotation_4x4(body.T)
    local = staged.copy()
    parents = rig.parents.numpy()
    below = np.nonzero(parents >= 0)[0]
    local[:, below] = np.linalg.inv(staged[:, parents[below]]) @ staged[:, below]
    return StagedAvatar(
        rest_points_m=rig.vertices_m.double().numpy() @ body.T,
        faces=rig.faces.numpy(),
        uvs=layout.uvs.astype(np.float64),
        face_uvs=layout.face_uvs,
        skin_joints=rig.skin_joints.numpy(),
        skin_weights=rig.skin_weights.double().numpy(),
        joint_names=rig.joint_names,
        parents=parents,
        rest_joints_m=rig.joints_m.double().numpy() @ body.T,
        frames=np.array(clothed.frames),
        translations_m=local[..., :3, 3],
        quaternions=_continuous_quaternions(local[..., :3, :3]),
        points_m=surfaces_m @ world.T.astype(np.float32),
        shapes_m=correctives.offsets_m @ body.T.astype(np.float32),
        shape_weights=correctives.weights,
        texture=texture,
        stage_from_world=world,
    )


def stage_from_world(up: str) -> np.ndarray:
    """Return the rotation (3, 3) from world axes to Y up."""
    return {"z": Y_UP_FROM_Z_UP, "y": np.eye(3)}[up]


def _rotation_4x4(rotation: np.ndarray) -> np.ndarray:
    full = np.eye(4)
    full[:3, :3] = rotation
    return full


def _continuous_quaternions(rotations: np.ndarray) -> np.ndarray:
    """Convert rotations (n, J, 3, 3) to quaternions (n, J, 4) as x y z w, each on the same hemisphere as in the frame
    before."""
    quaternions = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_quat().reshape(*rotations.shape[:2], 4)
    same_side = (quaternions[1:] * quaternions[:-1]).sum(-1, keepdims=True) >= 0
    quaternions[1:] *= np.cumprod(np.where(same_side, 1, -1), axis=0)
    return quaternions

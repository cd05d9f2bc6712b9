"""The body as plain tensors: linear blend skinning of one linearised shape space.

This is all that fitting, training and export need of a body model. anny, SMPL and SMPL-X are converted to a Rig once;
after that no body-model package is used. The body frame is the model's own: metres, anny's Z up, facing -Y.

Rotations are axis-angle, about a joint's rest position, in axes parallel to the body frame in the rest pose (as in
SMPL, Loper et al. 2015), so every rest orientation is the identity.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hnerf.body.limbs import Limbs

AXES = {  # of Rig's arrays, in the letters of its docstring; P: keypoints
    "vertices_m": "V3", "faces": "F3", "joints_m": "J3", "joint_names": "J", "parents": "J", "beta": "B",
    "beta_names": "B", "shape_basis": "BV3", "joint_basis": "BJ3", "skin_joints": "VK", "skin_weights": "VK",
    "free": "J", "keypoint_weights": "PV",
}  # fmt: skip
INDICES = {"faces": "V", "parents": "J", "skin_joints": "J"}  # the axis that the values of these arrays index


@dataclass(frozen=True)
class Rig:
    """A rest body at shape `beta`, with its joints, skinning and keypoints.

    vertices_m (V, 3), faces (F, 3) long, joints_m (J, 3), parents (J,) long with -1 at the root and parents before
    children, shape_basis (B, V, 3) and joint_basis (B, J, 3): metres per unit of beta around `beta` (B,). skin_joints
    (V, K) long, skin_weights (V, K) summing to 1. free (J,) bool: joints that may turn. keypoint_weights (25, V):
    BODY_25 keypoints from the vertices.
    """

    vertices_m: Tensor
    faces: Tensor
    joints_m: Tensor
    joint_names: tuple[str, ...]
    parents: Tensor
    beta: Tensor
    beta_names: tuple[str, ...]
    shape_basis: Tensor
    joint_basis: Tensor
    skin_joints: Tensor
    skin_weights: Tensor
    free: Tensor
    keypoint_weights: Tensor

    @cached_property
    def levels(self) -> list[Tensor]:
        """Return the joints by depth in the tree: the root, its children, theirs, and so on, (k,) each."""
        depth = [0]
        for parent in self.parents.tolist()[1:]:
            depth.append(depth[parent] + 1)
        depths = torch.tensor(depth, device=self.parents.device)
        return [torch.nonzero(depths == level)[:, 0] for level in range(max(depth) + 1)]

    @cached_property
    def limbs(self) -> Limbs:
        """Return the trunk, arms and legs."""
        return Limbs.of(self)

    @cached_property
    def dense_weights(self) -> Tensor:
        """Return the skin weights of all joints, (V, J)."""
        dense = self.skin_weights.new_zeros(len(self.skin_weights), len(self.joints_m))
        return dense.scatter_add_(1, self.skin_joints, self.skin_weights)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "Rig":
        """Return the same rig on another device; `dtype` changes the floating-point tensors only."""
        changed: dict[str, Any] = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                changed[field.name] = value.to(device=device, dtype=dtype if value.is_floating_point() else None)
        return dataclasses.replace(self, **changed)

    def shaped(self, beta: Tensor) -> tuple[Tensor, Tensor]:
        """Return rest vertices (V, 3) and joints (J, 3) at another shape (B,), to first order around `self.beta`."""
        delta = beta - self.beta
        vertices_m = self.vertices_m + torch.einsum("b,bvd->vd", delta, self.shape_basis)
        return vertices_m, self.joints_m + torch.einsum("b,bjd->jd", delta, self.joint_basis)

    def reshaped(self, beta: Tensor) -> "Rig":
        """Return the rig at another shape (B,), along the same basis."""
        vertices_m, joints_m = self.shaped(beta)
        return dataclasses.replace(self, vertices_m=vertices_m, joints_m=joints_m, beta=beta)

    def save(self, path: Path) -> None:
        """Write the rig as .npz without pickles."""
        arrays: dict[str, Any] = {f.name: np.asarray(getattr(self, f.name)) for f in dataclasses.fields(self)}
        np.savez(path, **arrays)

    @staticmethod
    def load(path: Path) -> "Rig":
        """Read what `save` wrote. Raises ValueError if its arrays do not fit each other."""
        with np.load(path, allow_pickle=False) as stored:
            _require_agreement({f.name: stored[f.name] for f in dataclasses.fields(Rig)})
            values: dict[str, Any] = {
                f.name: tuple(map(str, stored[f.name]))
                if f.name in ("joint_names", "beta_names")
                else torch.from_numpy(stored[f.name])
                for f in dataclasses.fields(Rig)
            }
        return Rig(**values)


def _require_agreement(arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError, naming the array, if one does not have its axes in AXES, or holds an index out of range."""
    sizes = {"3": 3}
    for name, axes in AXES.items():
        shape = arrays[name].shape
        if len(shape) != len(axes) or any(sizes.setdefault(a, n) != n for a, n in zip(axes, shape, strict=True)):
            raise ValueError(f"{name} has shape {shape}")
    for name, counted in INDICES.items():
        if not (arrays[name] < sizes[counted]).all():
            raise ValueError(f"{name} has an index beyond {sizes[counted]}")


def shortest_rotation(a: Float[Tensor, "3"], b: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation (3, 3) of direction a into b, which is not opposite, about their common normal
    (Rodrigues)."""
    a, b = a / a.norm(), b / b.norm()
    cross = cross_matrix(torch.linalg.cross(a, b))
    return torch.eye(3, dtype=a.dtype) + cross + cross @ cross / (1 + a @ b)


def rotation_from_axis_angle(axis_angle: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Return rotations (..., 3, 3) of axis-angle (..., 3) in radians, by Rodrigues' formula with finite gradients at
    zero."""
    angle_squared = (axis_angle * axis_angle).sum(-1)[..., None, None]
    small = angle_squared < 1e-8
    safe = torch.where(small, torch.ones_like(angle_squared), angle_squared)
    angle = safe.sqrt()
    sinc = torch.where(small, 1 - angle_squared / 6, angle.sin() / angle)
    half = torch.where(small, 0.5 - angle_squared / 24, (1 - angle.cos()) / safe)
    cross = cross_matrix(axis_angle)
    return torch.eye(3, dtype=cross.dtype, device=cross.device) + sinc * cross + half * (cross @ cross)


def cross_matrix(vectors: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Return the matrices [v] (..., 3, 3) of vectors v (..., 3), for which [v] w is v x w."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def joint_transforms(
    rig: Rig, theta: Float[Tensor, "*n J 3"], root: Float[Tensor, "*n 4 4"]
) -> Float[Tensor, "*n J 4 4"]:
    """Return the world transform of every joint, (..., J, 4, 4).

    theta (..., J, 3) radians; root (..., 4, 4) world from body (T in docs/method.md).
    """
    rotations, offsets = rotation_from_axis_angle(theta), _relative_to_parent(rig, rig.joints_m)
    top = torch.cat([rotations, offsets[..., None].expand(*rotations.shape[:-1], 1)], -1)
    bottom = torch.tensor([0, 0, 0, 1], dtype=top.dtype, device=top.device).expand(*top.shape[:-2], 1, 4)
    own = torch.cat([top, bottom], -2)
    first = root[..., None, :, :] @ own[..., :1, :, :]
    return _along_chain(rig, first, lambda above, joints: above @ own[..., joints, :, :])


def posed_joint_basis(
    rig: Rig, world: Float[Tensor, "n J 4 4"], root: Float[Tensor, "n 4 4"]
) -> Float[Tensor, "n J 3 B"]:
    """Return how a unit of each shape value moves the posed joints, (n, J, 3, B) metres. world (n, J, 4, 4):
    `joint_transforms`; root (n, 4, 4)."""
    offsets = _relative_to_parent(rig, rig.joint_basis.transpose(0, 1)).transpose(1, 2)  # (J, 3, B)
    turned = world[:, rig.parents.clamp(min=0), :3, :3] @ offsets
    first = root[:, None, :3, :3] @ offsets[:1]
    return _along_chain(rig, first, lambda above, joints: above + turned[:, joints])


def skinning_transforms(world: Float[Tensor, "*n J 4 4"], joints_m: Float[Tensor, "J 3"]) -> Float[Tensor, "*n J 4 4"]:
    """Return world from rest pose for a point rigidly attached to each joint, (..., J, 4, 4): G_j [I | -joint_j].
    world: G, of `joint_transforms`; joints_m (J, 3) at rest."""
    moved = world[..., :3, 3] - (world[..., :3, :3] @ joints_m[..., None])[..., 0]
    return torch.cat([torch.cat([world[..., :3, :3], moved[..., None]], -1), world[..., 3:, :]], -2)


def pose_vertices(rig: Rig, theta: Float[Tensor, "*n J 3"], root: Float[Tensor, "*n 4 4"]) -> Float[Tensor, "*n V 3"]:
    """Return posed vertices in the world, (..., V, 3) metres. theta (..., J, 3), root (..., 4, 4)."""
    transforms = vertex_skinning(rig, theta, root)
    return (transforms[..., :3, :3] @ rig.vertices_m[..., None])[..., 0] + transforms[..., :3, 3]


def vertex_skinning(
    rig: Rig, theta: Float[Tensor, "*n J 3"], root: Float[Tensor, "*n 4 4"]
) -> Float[Tensor, "*n V 3 4"]:
    """Return world from rest pose for every vertex, (..., V, 3, 4). theta (..., J, 3), root (..., 4, 4)."""
    return vertex_transforms(rig, skinning_transforms(joint_transforms(rig, theta, root), rig.joints_m))


def vertex_transforms(rig: Rig, transforms: Float[Tensor, "*n J 4 4"]) -> Float[Tensor, "*n V 3 4"]:
    """Blend joint transforms (..., J, 4, 4) by skin weights: (..., V, 3, 4), world from rest pose."""
    top = transforms[..., :3, :].flatten(-2)  # (..., J, 12)
    return (rig.dense_weights @ top).unflatten(-1, (3, 4))


def _relative_to_parent(rig: Rig, values: Tensor) -> Tensor:
    """Return values (J, ...) of joints minus those of their parents; the root's are kept."""
    return torch.cat([values[:1], values[1:] - values[rig.parents[1:]]])


def _along_chain(rig: Rig, first: Tensor, step: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Return values of all joints (..., J, a, b), computed from the root's (..., 1, a, b) level by level: step(values
    of the parents, joints (k,))."""
    values, before = [first], rig.levels[0]
    for joints in rig.levels[1:]:
        values.append(step(values[-1][..., torch.searchsorted(before, rig.parents[joints]), :, :], joints))
        before = joints
    return torch.cat(values, -3)[..., torch.cat(rig.levels).argsort(), :, :]

"""Points carried by the moving joints, with their analytic Jacobian.

Locked joints follow their nearest free ancestor rigidly, so a rig of a hundred joints reduces to about twenty that
move. Locked joints that are turned nevertheless (those of fingers) keep their turn. A point's world position is linear
in the moving joints' transforms and in the shape: x = sum_m R_m (a_m - w_m q_m) + w_m p_m with rest joint q_m, posed
joint p_m, and a_m the point's rest position times its weight w_m on joint m.

The unknowns of a frame, in this order: the root joint's displacement (3) in metres, a rotation about it (3) in world
axes, then the change of axis-angle (3) of every other moving joint.
"""

import functools
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from hnerf.body.rig import (
    Rig,
    cross_matrix,
    joint_transforms,
    pose_vertices,
    posed_joint_basis,
    rotation_from_axis_angle,
)


@dataclass(frozen=True)
class Pose:
    """The state that a fit optimises: the shape, the poses of n frames, and keypoint offsets.

    rig: linearised at the shape, its `beta` (B,); theta (n, J, 3) radians, zero at the root; root (n, 4, 4) world from
    body, metres; offsets_m (25, 3): where the detector sees each keypoint on the rest body, minus where the body model
    places it.
    """

    rig: Rig
    theta: Tensor
    root: Tensor
    offsets_m: Tensor


@dataclass(frozen=True)
class Points:
    """P points on the rest body: weights (P, M) on the moving joints; rest_m (P, M, 3) and basis_m (P, M, 3, B),
    position and shape basis already multiplied by the weight."""

    weights: Tensor
    rest_m: Tensor
    basis_m: Tensor


@dataclass(frozen=True)
class PosedJoints:
    """Moving joints in the world: rotations (n, M, 3, 3); positions_m (n, M, 3); axes (n, M, 3, 3), whose columns are
    the world rotation vectors of the joint's three unknowns; shape_m (n, M, 3, B), displacement per unit of beta."""

    rotations: Tensor
    positions_m: Tensor
    axes: Tensor
    shape_m: Tensor


@dataclass(frozen=True)
class PosedSkin(PosedJoints):
    """Moving joints, and the part of the skin's position that they do not explain. bent_m (n, K, 3): displacement that
    turns of locked joints add to the vertices `bent` (K,), which the moving joints `bent_by` (K,) carry."""

    bent: Tensor
    bent_by: Tensor
    bent_m: Tensor


@dataclass(frozen=True)
class FixedParts:
    """The parts of an articulation that do not depend on the shape.

    joints (M,): the rig's moving joints; parents (M,): the moving joint above each of them; carrier (J,): the moving
    joint that each of the rig's joints follows. subtree (M, M): 1 at [j, m] if turning j moves m. vertex_weights (V,
    M). keypoint_vertices (V,) bool: the U vertices that keypoints are sums of; keypoint_carried (25, M) bool: the N
    pairs of a keypoint and a moving joint that carries part of it; keypoint_split (N, U): each vertex's contribution to
    each pair.
    """

    joints: Tensor
    parents: Tensor
    carrier: Tensor
    subtree: Tensor
    vertex_weights: Tensor
    keypoint_vertices: Tensor
    keypoint_carried: Tensor
    keypoint_split: Tensor


class Articulation:
    """The moving joints of a rig: the root (index 0), then the free joints, parents first."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.fixed = _fixed_parts(rig.parents, rig.free, rig.skin_joints, rig.skin_weights, rig.keypoint_weights)
        self.joints, self.parents, self.carrier = self.fixed.joints, self.fixed.parents, self.fixed.carrier
        self.subtree, self.vertex_weights = self.fixed.subtree, self.fixed.vertex_weights
        self.rest_m, self.rest_basis_m = rig.joints_m[self.joints], rig.joint_basis[:, self.joints].permute(1, 2, 0)
        self.unknowns = 3 + 3 * len(self.joints)

    def keypoints(self) -> Points:
        """Return the 25 BODY_25 keypoints as points on the rest body."""
        used, carried, split = self.fixed.keypoint_vertices, self.fixed.keypoint_carried, self.fixed.keypoint_split
        columns = torch.cat([self.rig.vertices_m[None, used], self.rig.shape_basis[:, used]]).transpose(0, 1).flatten(1)
        sums = torch.zeros(*carried.shape, columns.shape[1], dtype=columns.dtype)
        sums[carried] = split @ columns
        sums = sums.unflatten(-1, (-1, 3)).transpose(-1, -2)  # (25, M, 3, 1 + B)
        shares = torch.zeros(carried.shape, dtype=split.dtype)
        shares[carried] = split.sum(1)
        return Points(shares, sums[..., 0], sums[..., 1:])

    def pose(self, pose: Pose) -> PosedJoints:
        """Place the moving joints in the world."""
        world = joint_transforms(self.rig, pose.theta, pose.root)
        rotations, positions = world[:, self.joints, :3, :3], world[:, self.joints, :3, 3]
        above = rotations[:, self.parents]
        axes = above @ left_jacobian(pose.theta[:, self.joints])
        axes[:, 0] = torch.eye(3, dtype=axes.dtype)
        shape = posed_joint_basis(self.rig, world, pose.root)[:, self.joints]
        return PosedJoints(rotations, positions, axes, shape)

    def skin(self, pose: Pose) -> PosedSkin:
        """Place the moving joints and the skin in the world."""
        joints = self.pose(pose)
        bent, bent_by = self._bent_vertices(pose.theta)
        part = replace(
            self.rig,
            vertices_m=self.rig.vertices_m[bent],
            skin_joints=self.rig.skin_joints[bent],
            skin_weights=self.rig.skin_weights[bent],
        )
        bent_m = pose_vertices(part, pose.theta, pose.root) - self._rigid(bent, joints.rotations, joints.positions_m)
        return PosedSkin(**vars(joints), bent=bent, bent_by=bent_by, bent_m=bent_m)

    def _bent_vertices(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Return the vertices (K,) on locked joints that are turned in some frame, or on joints below these, and the
        moving joints (K,) that carry the vertices."""
        turned = (theta != 0).any(-1).any(0)
        turned[self.joints] = False
        for j, parent in enumerate(self.rig.parents.tolist()):
            turned[j] |= parent >= 0 and turned[parent]
        on_turned = turned[self.rig.skin_joints] & (self.rig.skin_weights > 0)
        bent = on_turned.any(1).nonzero()[:, 0]
        slot = on_turned[bent].int().argmax(1)
        return bent, self.carrier[self.rig.skin_joints[bent, slot]]

    def _rigid(self, ids: Tensor | slice, rotations: Tensor, positions_m: Tensor) -> Tensor:
        """Return vertices `ids` (K,) as the moving joints carry them, (..., K, 3) world. rotations (..., M, 3, 3),
        positions_m (..., M, 3): of the moving joints."""
        moved = positions_m - (rotations @ self.rest_m[..., None])[..., 0]
        blended = self.vertex_weights[ids] @ torch.cat([rotations.flatten(-2), moved], -1)
        return (blended[..., :9].unflatten(-1, (3, 3)) @ self.rig.vertices_m[ids, :, None])[..., 0] + blended[..., 9:]

    def surface(self, skin: PosedSkin, frame: int) -> Tensor:
        """Return every vertex in one frame, (V, 3) world."""
        surface = self._rigid(slice(None), skin.rotations[frame], skin.positions_m[frame])
        surface[skin.bent] += skin.bent_m[frame]
        return surface

    def jacobian(self, points: Points, joints: PosedJoints) -> tuple[Tensor, Tensor, Tensor]:
        """Return positions (n, P, 3), and their derivatives with respect to the frame's unknowns (n, P, 3, U) and beta
        (n, P, 3, B)."""
        carried = self._weighted_positions(points, joints)
        moved = torch.einsum("jm,npmd->npjd", self.subtree, carried)
        lever = moved - torch.einsum("jm,pm->pj", self.subtree, points.weights)[..., None] * joints.positions_m[:, None]
        axes = joints.axes.transpose(-1, -2)[:, None]  # (n, 1, M, 3 unknowns, 3)
        by_rotation = torch.linalg.cross(axes, lever[..., None, :].expand(*lever.shape[:-1], 3, 3))
        position = carried.sum(2)
        shift = torch.eye(3, dtype=by_rotation.dtype).expand(*position.shape, 3)
        frame = torch.cat([shift, by_rotation.flatten(2, 3).transpose(-1, -2)], -1)
        rest_basis = points.basis_m - points.weights[..., None, None] * self.rest_basis_m
        shape = torch.einsum("nmcd,pmdb->npcb", joints.rotations, rest_basis)
        shape += torch.einsum("pm,nmcb->npcb", points.weights, joints.shape_m)
        return position, frame, shape

    def directional_jacobian(
        self, ids: Tensor, directions: Tensor, skin: PosedSkin, frame: int
    ) -> tuple[Tensor, Tensor]:
        """Return derivatives of the positions of vertices `ids` (P,) along directions (P, 3), with respect to the
        frame's unknowns (P, U) and beta (P, B). Equal to `jacobian` times the directions, without forming it."""
        weights, rest = self.vertex_weights[ids], self.rig.vertices_m[ids, None] - self.rest_m
        rotations, positions = skin.rotations[frame], skin.positions_m[frame]
        carried = weights[..., None] * (torch.einsum("mcd,pmd->pmc", rotations, rest) + positions)
        bent = torch.searchsorted(skin.bent, ids.contiguous()).clamp(max=max(len(skin.bent) - 1, 0))
        rows = (skin.bent[bent] == ids).nonzero()[:, 0] if len(skin.bent) else ids[:0]
        carried[rows, skin.bent_by[bent[rows]]] += skin.bent_m[frame, bent[rows]]
        lever = torch.einsum("jm,pmd->pjd", self.subtree, carried) - (weights @ self.subtree.T)[..., None] * positions
        torque = torch.linalg.cross(lever, directions[:, None].expand_as(lever))
        by_rotation = torch.einsum("pmc,mcu->pmu", torque, skin.axes[frame]).flatten(1)
        pulled = weights[..., None] * torch.einsum("pc,mcd->pmd", directions, rotations)
        shape = torch.einsum("pd,bpd->pb", pulled.sum(1), self.rig.shape_basis[:, ids])
        shape -= pulled.flatten(1) @ self.rest_basis_m.flatten(0, 1)
        shape += (weights[..., None] * directions[:, None]).flatten(1) @ skin.shape_m[frame].flatten(0, 1)
        return torch.cat([directions, by_rotation], 1), shape

    def _weighted_positions(self, points: Points, joints: PosedJoints) -> Tensor:
        """Return each point as every moving joint would carry it alone, times the joint's weight, (n, P, M, 3)."""
        rest = points.rest_m - points.weights[..., None] * self.rest_m
        turned = torch.einsum("nmcd,pmd->npmc", joints.rotations, rest)
        return turned + points.weights[..., None] * joints.positions_m[:, None]

    def apply_step(self, pose: Pose, step: Tensor) -> Pose:
        """Return the pose after a step (n, U) of the frames' unknowns."""
        theta = pose.theta.clone()
        theta[:, self.joints[1:]] += step[:, 6:].unflatten(-1, (-1, 3))
        rotation = rotation_from_axis_angle(step[:, 3:6]) @ pose.root[:, :3, :3]
        root = pose.root.clone()
        root[:, :3, 3] += step[:, :3] + (pose.root[:, :3, :3] - rotation) @ self.rest_m[0]
        root[:, :3, :3] = rotation
        return replace(pose, theta=theta, root=root)


@functools.lru_cache(maxsize=4)  # keyed by tensor identity: the rigs of one body share these tensors at every shape
def _fixed_parts(
    parents: Tensor, free: Tensor, skin_joints: Tensor, skin_weights: Tensor, keypoint_weights: Tensor
) -> FixedParts:
    moves = free.clone()
    moves[0] = True
    joints = moves.nonzero()[:, 0]
    carrier = torch.zeros(len(moves), dtype=torch.long)
    slot = moves.cumsum(0) - 1
    for j, parent in enumerate(parents.tolist()):
        carrier[j] = slot[j] if moves[j] else carrier[parent]
    above = carrier[parents[joints].clamp(min=0)]
    subtree = torch.eye(len(joints), dtype=skin_weights.dtype)
    for m in range(1, len(joints)):
        subtree[:, m] += subtree[:, above[m]]
    weights = torch.zeros(len(skin_weights), len(joints), dtype=skin_weights.dtype)
    weights.scatter_add_(1, carrier[skin_joints], skin_weights)
    used = (keypoint_weights != 0).any(0)
    carried = (keypoint_weights != 0).float() @ (weights != 0).float() > 0  # true for few pairs
    keypoint, joint = carried.nonzero(as_tuple=True)
    split = keypoint_weights[keypoint][:, used] * weights[used].T.contiguous()[joint]
    return FixedParts(joints, above, carrier, subtree, weights, used, carried, split)


def with_offsets(points: Points, offsets_m: Tensor) -> Points:
    """Return keypoints displaced on the rest body by offsets_m (P, 3)."""
    return replace(points, rest_m=points.rest_m + points.weights[..., None] * offsets_m[:, None])


def left_jacobian(axis_angle: Tensor) -> Tensor:
    """Return the left Jacobian of SO(3) at rotation vectors (..., 3): J (..., 3, 3) with R(v + dv) = R(J dv) R(v) to
    first order.

    J = I + (1 - cos a)/a^2 [v] + (a - sin a)/a^3 [v]^2 (Barfoot 2017, eq. 7.37).
    """
    squared = (axis_angle * axis_angle).sum(-1)[..., None, None]
    small = squared < 1e-8
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    first = torch.where(small, 0.5 - squared / 24, (1 - angle.cos()) / safe)
    second = torch.where(small, 1 / 6 - squared / 120, (angle - angle.sin()) / (safe * angle))
    cross = cross_matrix(axis_angle)
    return torch.eye(3, dtype=cross.dtype) + first * cross + second * (cross @ cross)

"""World points relative to the canonical body: (d, s) of the paper, and y = s + L^-1 (x - p).

p is the closest point on the posed body, s the same point on the rest body, and L the blended linear part of the
skinning there, so y equals s + d n(s) where the skin moves rigidly, and stays continuous across edges where n(s) does
not.
"""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from hnerf.body.correction_pull import Displacement
from hnerf.body.descriptor import BodyMeshes, ClosestPoints
from hnerf.body.rig import (
    Rig,
    joint_transforms,
    posed_joint_basis,
    rotation_from_axis_angle,
    skinning_transforms,
    vertex_transforms,
)

ON_EDGE = 1e-5  # barycentric weights below this count as zero
FAR_M = 10.0  # a reach that includes every point that is queried


@dataclass(frozen=True)
class Descriptor:
    """What the body prior gives for N points: d (N,) metres, negative inside; s (N, 3) on the rest body; y (N, 3)
    canonical position; near (N,) bool: within reach (where False, all else is meaningless); corners (N, 3): vertices of
    the closest triangle; barycentric (N, 3) of the closest point in it."""

    d: Tensor
    s: Tensor
    y: Tensor
    near: Tensor
    corners: Tensor
    barycentric: Tensor

    @property
    def vertex(self) -> Tensor:
        """Return the corner of the closest triangle that is nearest to the closest point, (N,)."""
        return nearest_corner(self.corners, self.barycentric)

    def pick(self, rows: Tensor) -> "Descriptor":
        """Return the descriptors of `rows` (M,)."""
        return Descriptor(*(getattr(self, field.name).index_select(0, rows) for field in fields(self)))

    def followed_by(self, other: "Descriptor") -> "Descriptor":
        """Return these descriptors and others after them."""
        return Descriptor(*(torch.cat([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)))


class PoseCorrection(nn.Module):
    """Small changes of pose and shape, learned while the body meshes stay fixed (Delta theta_t, Delta beta of the
    paper).

    Each frame has small twists of the free joints and the root, in world axes, (n, free + 1, 3), and a displacement of
    the root, (n, 3); one change of shape, (B,), applies to all frames. A twist moves a point in proportion to its skin
    weight on the joint and the joint's descendants: skinning linearised for one bone, blended between bones.
    `PosedBodies.absorb` turns the correction into theta, T and beta.
    """

    absorbed_turn: Tensor
    absorbed_move_m: Tensor
    absorbed_shape: Tensor

    def __init__(self, frames: int, free_joints: int, shapes: int):
        super().__init__()
        self.turn = nn.Parameter(torch.zeros(frames, free_joints + 1, 3))
        self.move_m = nn.Parameter(torch.zeros(frames, 3))
        self.shape = nn.Parameter(torch.zeros(shapes))
        for name, parameter in list(self.named_parameters()):
            self.register_buffer(f"absorbed_{name}", torch.zeros_like(parameter.data))

    def totals(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the total (turn, move_m, shape) since the fit, including what was absorbed."""
        return (self.turn + self.absorbed_turn, self.move_m + self.absorbed_move_m, self.shape + self.absorbed_shape)


class PosedBodies:
    """The body in several poses: closest points, descriptors, and their derivatives with respect to pose and shape."""

    def __init__(self, rig: Rig, theta: Tensor, root: Tensor, canonical_m: Tensor):
        """Pose the rig: theta (n, J, 3), root (n, 4, 4). canonical_m (V, 3): the rest body that s and y refer to,
        whatever the shape."""
        self.rig = rig
        self._canonical_m = canonical_m
        self._free = torch.nonzero(rig.free)[:, 0]
        self._skin_joints = rig.skin_joints.int()
        self._pose(theta, root)
        self._meshes = BodyMeshes(self.vertices_m, rig.faces)
        self._limbs = rig.limbs
        self._close = self._limbs.close(self.vertices_m)
        close = torch.nonzero(self._close.flatten(0, 1).any(0))[:, 0].tolist()
        self._faces_of = {limb: torch.nonzero(self._limbs.face_limb == limb)[:, 0] for limb in close}
        self._limb_meshes = {k: BodyMeshes(self.vertices_m, rig.faces[faces]) for k, faces in self._faces_of.items()}

    def set_poses(self, rig: Rig, theta: Tensor, root: Tensor) -> None:
        """Replace the poses and the shape by similar ones, in which the same limbs are close to each other."""
        self.rig = rig
        self._pose(theta, root)
        for meshes in (self._meshes, *self._limb_meshes.values()):
            meshes.refit(self.vertices_m)

    def _pose(self, theta: Tensor, root: Tensor) -> None:
        self.theta, self.root = theta.detach(), root.detach()
        rig = self.rig
        self._joints = joint_transforms(rig, self.theta, self.root)
        posed = vertex_transforms(rig, skinning_transforms(self._joints, rig.joints_m))
        self._linear = posed[..., :3].contiguous()
        self._inverse = torch.linalg.inv(self._linear).contiguous()
        self.vertices_m = (self._linear @ rig.vertices_m[..., None])[..., 0] + posed[..., 3]
        # How a unit of each shape value moves the points that each joint carries rigidly, (n, J, 3, B) metres: the
        # joint's displacement in the world minus its rotated displacement in the rest body.
        turned = self._joints[..., :3, :3] @ rig.joint_basis.permute(1, 2, 0)
        self._joint_shape = posed_joint_basis(rig, self._joints, self.root) - turned

    def correction(self) -> PoseCorrection:
        """Return a correction of zero for these frames."""
        return PoseCorrection(len(self.theta), len(self._free), len(self.rig.beta)).to(self.rig.vertices_m.device)

    def describe(
        self, points_m: Tensor, frame: Tensor, reach_m: float, correction: PoseCorrection | None = None,
        exact_sign: bool = False,
    ) -> Descriptor:  # fmt: skip
        """Return descriptors of world points (N, 3) relative to the bodies of rows `frame` (N,); gradients flow to the
        points and the correction. Those of s and y take the skin around the closest point for rigid
        (docs/method.md, "The body prior")."""
        found = self._meshes.closest_points(points_m, frame, reach_m, exact_sign)
        return self._described(points_m, frame, found, correction)

    def describe_by_limbs(
        self, points_m: Tensor, frame: Tensor, reach_m: float, correction: PoseCorrection | None = None,
        exact_sign: bool = False, beside_m: Tensor | None = None,
    ) -> tuple[Descriptor, Tensor]:  # fmt: skip
        """Return what `describe` returns, followed by M descriptors relative to limbs other than the closest one, where
        the pose brings them close to it; and the points that these M belong to, (M,). No s follows the points.

        beside_m (K, N, 3): describe instead the points moved by K offsets each, (K N,), to first order, with one search
        for the closest points.
        """
        found = self._meshes.closest_points(points_m, frame, reach_m, exact_sign)
        closest = self._described(points_m, frame, found, correction, False, beside_m)
        if not self._limb_meshes:
            return closest, torch.zeros(0, dtype=torch.long, device=frame.device)
        close = self._close[frame.long(), closest.vertex[: len(frame)]] & closest.near[: len(frame), None]
        more, found = self._closest_on_limbs(points_m, frame, reach_m, close)
        beside_m = None if beside_m is None else beside_m[:, more]
        other = self._described(points_m[more], frame[more], found, correction, False, beside_m)
        copies = torch.arange(1 if beside_m is None else len(beside_m), device=more.device)
        return closest.followed_by(other), (more + len(points_m) * copies[:, None]).flatten()

    def _closest_on_limbs(
        self, points_m: Tensor, frame: Tensor, reach_m: float, asked: Tensor
    ) -> tuple[Tensor, ClosestPoints]:
        """Return which points are within reach of a limb that is queried for them, (M,), and their closest points on
        it. asked (N, L) bool: the limbs to query. Closest points on the cut where a limb joins the body are dropped: it
        is no surface."""
        found = []
        for limb, meshes in self._limb_meshes.items():
            points = torch.nonzero(asked[:, limb])[:, 0]
            at = meshes.closest_points(points_m[points], frame[points], reach_m)
            face = self._faces_of[limb][at.face.clamp(min=0)]
            on_end = (self._limbs.on_cut[self.rig.faces[face]] | (at.barycentric < ON_EDGE)).all(1)
            kept = torch.nonzero((at.face >= 0) & ~on_end)[:, 0]
            found.append((points[kept], face[kept], at.barycentric[kept], at.sign[kept]))
        more, *closest = (torch.cat(parts) for parts in zip(*found, strict=True))
        return more, ClosestPoints(*closest)

    def _described(
        self, points_m: Tensor, frame: Tensor, found: ClosestPoints, correction: PoseCorrection | None,
        s_follows: bool = True, beside_m: Tensor | None = None,
    ) -> Descriptor:  # fmt: skip
        """Return the descriptors of points from their closest points; the arguments are those of `describe_by_limbs`.
        Gradients flow through s only if `s_follows`."""
        moved = points_m - points_m.detach()  # zero, but carries the gradient
        if beside_m is not None:
            many = len(beside_m)
            found = ClosestPoints(*(torch.cat([t] * many) for t in (found.face, found.barycentric, found.sign)))
            points_m, frame, moved = torch.cat([points_m] * many), torch.cat([frame] * many), beside_m.flatten(0, 1)
        corners = self.rig.faces.index_select(0, found.face.clamp(min=0))  # (N, 3)
        posed = frame.long()[:, None] * len(self.rig.vertices_m) + corners
        p = weighted_sum(self.vertices_m.flatten(0, 1), posed, found.barycentric)
        s = weighted_sum(self._canonical_m, corners, found.barycentric)
        inverse = weighted_sum(self._inverse.flatten(0, 1).flatten(1), posed, found.barycentric).unflatten(-1, (3, 3))
        offset = points_m.detach() - p
        distance = offset.norm(dim=-1)
        normal = found.sign[:, None] * offset / distance.clamp(min=1e-9)[:, None]
        if correction is not None:
            nearest = nearest_corner(corners, found.barycentric)
            moved = moved - self._displacement(points_m.detach(), frame, nearest, correction)
        y = s + (inverse * (offset + moved)[:, None]).sum(-1)  # faster than many small matrix products
        if s_follows and moved.requires_grad:  # only gradients need it
            s = s + (inverse * self._closest_point_motion(posed, found.barycentric, normal, moved)[:, None]).sum(-1)
        d = found.sign * distance + (normal * moved).sum(-1)
        return Descriptor(d, s, y, found.face >= 0, corners, found.barycentric)

    def turn(self, directions: Tensor, frame: Tensor, corners: Tensor, barycentric: Tensor) -> Tensor:
        """Return canonical directions (N, 3) turned into the world by the skinning of rows `frame` (N,), at points in
        triangles; corners, barycentric (N, 3): as in Descriptor."""
        posed = frame.long()[:, None] * len(self.rig.vertices_m) + corners
        linear = weighted_sum(self._linear.flatten(0, 1).flatten(1), posed, barycentric).unflatten(-1, (3, 3))
        return (linear * directions[:, None]).sum(-1)

    def _closest_point_motion(self, posed: Tensor, barycentric: Tensor, normal: Tensor, moved: Tensor) -> Tensor:
        """Return how the closest point follows when the queried point moves by `moved` (N, 3): along the face it lies
        on, along the edge if it lies on one, not at all if it is a vertex. posed (N, 3): rows of the posed vertices."""
        on_face = moved - normal * (normal * moved).sum(-1, keepdim=True)
        away = barycentric < ON_EDGE
        cornered = torch.nonzero(away.any(1))[:, 0]
        edge = (away[cornered].sum(1) == 1).float()[:, None]
        opposite = away[cornered].int().argmax(1)
        ends = [posed[cornered, (opposite + k) % 3] for k in (1, 2)]
        start, end = (self.vertices_m.flatten(0, 1).index_select(0, rows) for rows in ends)
        along = nn.functional.normalize(end - start, dim=-1)
        on_edge = edge * along * (along * moved.index_select(0, cornered)).sum(-1, keepdim=True)
        return on_face.index_copy(0, cornered, on_edge)

    @cached_property
    def _subtree_weights(self) -> Tensor:
        """Return the skin weight of each free joint with all its descendants, (V, free + 1); the last column is the
        root's, 1."""
        rig, dense = self.rig, self.rig.dense_weights.clone()
        for joint in range(len(rig.joints_m) - 1, 0, -1):
            dense[:, rig.parents[joint]] += dense[:, joint]
        return torch.cat([dense[:, self._free], dense.new_ones(len(dense), 1)], 1)

    def _displacement(self, points_m: Tensor, frame: Tensor, nearest: Tensor, correction: PoseCorrection) -> Tensor:
        """Return how far the correction carries the body at each point, whose nearest vertex is `nearest` (N,): (N, 3)
        metres."""
        pivots = torch.cat([self._joints[:, self._free, :3, 3], self._joints[:, :1, :3, 3]], 1)  # (n, free + 1, 3)
        shift = -torch.linalg.cross(correction.turn, pivots)
        shift = torch.cat([shift[:, :-1], shift[:, -1:] + correction.move_m[:, None]], 1)  # the root carries everything
        bulge = torch.einsum("b,bvd->vd", correction.shape, self.rig.shape_basis)
        carried = self._joint_shape @ correction.shape
        posed = (frame * len(bulge) + nearest).int()
        bodies = (self._subtree_weights, self._linear.flatten(0, 1), self._skin_joints, self.rig.skin_weights)
        return Displacement.apply(torch.stack([correction.turn, shift], 2), bulge, carried, points_m, posed, *bodies)

    @torch.no_grad()
    def absorb(self, correction: PoseCorrection, same_posture: Tensor | None = None) -> None:
        """Move the bodies by the correction, exactly through the kinematic chain, and set it to zero. Rows
        `same_posture` share one posture: their joints get the mean rotation."""
        rig, free = self.rig, self._free
        rotations = rotation_from_axis_angle(self.theta)
        above = self._joints[:, rig.parents[free].clamp(min=0), :3, :3]
        turned = (
            above.transpose(-1, -2) @ rotation_from_axis_angle(correction.turn[:, :-1]) @ above @ rotations[:, free]
        )
        theta, root = self.theta.clone(), self.root.clone()
        theta[:, free] = axis_angle_from_rotation(turned)
        if same_posture is not None:
            theta[same_posture] = theta[same_posture].mean(0)
            own = above @ rotation_from_axis_angle(theta[:, free]) @ (above @ rotations[:, free]).transpose(-1, -2)
            correction.turn[same_posture, :-1] = axis_angle_from_rotation(own)[same_posture]  # the turn actually made
        turn, pivot = rotation_from_axis_angle(correction.turn[:, -1]), self._joints[:, 0, :3, 3]
        root[:, :3, :3] = turn @ root[:, :3, :3]
        root[:, :3, 3] = (turn @ (root[:, :3, 3] - pivot)[..., None])[..., 0] + pivot + correction.move_m
        self.set_poses(rig.reshaped(rig.beta + correction.shape), theta, root)
        for name, parameter in correction.named_parameters():
            correction.get_buffer(f"absorbed_{name}").add_(parameter)
            parameter.zero_()


def nearest_corner(corners: Int[Tensor, "N K"], barycentric: Float[Tensor, "N K"]) -> Int[Tensor, " N"]:
    """Return which of the corners (N, 3) has the greatest barycentric weight, (N,)."""
    return corners.gather(1, barycentric.argmax(1, keepdim=True))[:, 0]


def weighted_sum(
    values: Float[Tensor, "V D"], corners: Int[Tensor, "N K"], barycentric: Float[Tensor, "N K"]
) -> Float[Tensor, "N D"]:
    """Return weighted sums (N, D) of rows of values (V, D): corners (N, K) name the rows, barycentric (N, K) their
    weights. One pass; gradients flow to the values only."""
    return _WeightedSum.apply(values, corners, barycentric.to(values))


class _WeightedSum(torch.autograd.Function):
    """`embedding_bag` with its own gradient: the built-in one sorts the corners and takes four times as long on a
    CPU."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, corners: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(corners, weights)
        ctx.rows = len(values)
        return nn.functional.embedding_bag(corners, values, per_sample_weights=weights, mode="sum")

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        corners, weights = ctx.saved_tensors
        shares = (gradient[:, None] * weights[..., None]).flatten(0, 1)
        total = gradient.new_zeros(ctx.rows, gradient.shape[1]).index_add_(0, corners.flatten(), shares)
        return total, None, None


def distinct_rows(rows: Int[Tensor, " N"], count: int) -> tuple[Int[Tensor, " K"], Int[Tensor, " N"]]:
    """Return which of `count` rows occur among `rows` (N,), and the position of each of `rows` among those, (N,);
    without sorting."""
    occurs = torch.zeros(count, dtype=torch.bool, device=rows.device)
    occurs[rows] = True
    return occurs.nonzero()[:, 0], (occurs.cumsum(0) - 1)[rows]


def axis_angle_from_rotation(rotation: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 3"]:
    """Return the axis-angle (..., 3) in radians of rotations (..., 3, 3), at most a half turn; without a gradient."""
    turns = Rotation.from_matrix(rotation.detach().cpu().double().reshape(-1, 3, 3).numpy()).as_rotvec()
    return torch.from_numpy(turns).to(rotation).view(rotation.shape[:-1])

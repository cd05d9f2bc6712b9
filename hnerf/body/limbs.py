"""Limbs, and where a pose brings them close to each other.

The closest point of the body does not tell which limb a point near two of them belongs to: where an arm touches a trunk
in a shirt, the shirt is closer to the bare arm than to the bare trunk. There, each limb is queried separately.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from hnerf.body.rig import Rig

FIRST_JOINTS = ("upperarm01.L", "upperarm01.R", "upperleg01.L", "upperleg01.R")  # trunk and head: all above them
CLOSE_M = 0.06  # from skin to skin; with 10 cm, renderings of valid-walk and valid-wave are the same
CLOSER_THAN_AT_REST = 0.5  # share of the distance at rest; limbs are always close where they join
SAMPLE_CELL_M = 0.04  # one vertex in each of these cells represents the others
NEAR_M = 10.0  # cdist sums products of coordinates: 100 m from the origin, it is off by centimetres


@dataclass(frozen=True)
class Limbs:
    """The parts of a body. vertex_limb (V,): 0 for trunk and head, or 1 + the index of the limb's first joint;
    face_limb (F,); on_cut (V,) bool: vertices where two limbs join; samples (P,): vertices that represent others;
    sample_of (V,): the sample of each vertex; rest_m (P, L): distance of a sample at rest from each limb."""

    vertex_limb: Tensor
    face_limb: Tensor
    on_cut: Tensor
    samples: Tensor
    sample_of: Tensor
    rest_m: Tensor

    @staticmethod
    def of(rig: "Rig") -> "Limbs":
        """Divide a rig into limbs; one without limb joints is all trunk."""
        of_joint = torch.zeros(len(rig.joints_m), dtype=torch.long)
        for joint, (name, parent) in enumerate(zip(rig.joint_names, rig.parents.tolist(), strict=True)):
            begins = name in FIRST_JOINTS
            of_joint[joint] = FIRST_JOINTS.index(name) + 1 if begins else of_joint[parent] if joint else 0
        joint_of_vertex = rig.skin_joints.gather(1, rig.skin_weights.argmax(1, keepdim=True))[:, 0]
        vertex_limb = of_joint.to(joint_of_vertex.device)[joint_of_vertex]
        corner_limbs = vertex_limb[rig.faces]
        face_limb = corner_limbs.amax(1)
        on_cut = torch.zeros(len(vertex_limb), dtype=torch.bool, device=face_limb.device)
        on_cut[rig.faces[corner_limbs.amin(1) < face_limb].flatten()] = True
        cell = torch.cat([(rig.vertices_m / SAMPLE_CELL_M).floor().long(), vertex_limb[:, None]], 1)
        cells, sample_of = torch.unique(cell, dim=0, return_inverse=True)
        vertices = torch.arange(len(cell), device=cell.device)
        samples = torch.full_like(cells[:, 0], len(cell)).scatter_reduce(0, sample_of, vertices, "amin")
        rest_m = _distances_m(rig.vertices_m[samples], vertex_limb[samples])
        return Limbs(vertex_limb, face_limb, on_cut, samples, sample_of, rest_m)

    def close(self, vertices_m: Tensor) -> Tensor:
        """Return which vertices of posed bodies (n, V, 3) come close to each of the L limbs, other than their own: (n,
        V, L) bool."""
        limb = self.vertex_limb[self.samples]
        distances_m = torch.stack([_distances_m(posed[self.samples], limb) for posed in vertices_m])
        close = (distances_m < CLOSE_M) & (distances_m < CLOSER_THAN_AT_REST * self.rest_m)
        return close[:, self.sample_of]


def _distances_m(points_m: Tensor, limb: Tensor) -> Tensor:
    """Return the distance of points (P, 3), on limbs (P,), from the points of each limb, (P, L); infinite for a limb
    without points, and for a point's own limb."""
    near_m = points_m - NEAR_M * (points_m.mean(0) / NEAR_M).round()
    distances_m = points_m.new_full((len(points_m), len(FIRST_JOINTS) + 1), torch.inf)
    for k in limb.unique().tolist():
        own = limb == k
        distances_m[~own, k] = torch.cdist(near_m[~own], near_m[own]).amin(1)
    return distances_m

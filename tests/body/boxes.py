"""Bodies small enough to work out by hand: a unit box, and a two-joint column of stacked boxes."""

import dataclasses

import torch
import trimesh
from torch import Tensor

from hnerf.body.rig import Rig


def box_vertices(height_m: float = 1.0, levels: int = 1) -> Tensor:
    """Return the corners of the unit square at levels + 1 heights, (4 (levels + 1), 3)."""
    square = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    heights = torch.linspace(0, height_m, levels + 1)
    return torch.cat([torch.cat([square, z.expand(4, 1)], 1) for z in heights])


def box_faces(levels: int = 1) -> Tensor:
    """Return the outward-facing triangles of the closed column."""
    faces = [[0, 2, 1], [0, 3, 2]]
    for level in range(levels):
        for k in range(4):
            a, b = 4 * level + k, 4 * level + (k + 1) % 4
            faces += [[a, b, b + 4], [a, b + 4, a + 4]]
    top = 4 * levels
    return torch.tensor([*faces, [top, top + 1, top + 2], [top, top + 2, top + 3]])


def box_rig(bend_segments: int = 0, splits: int = 0) -> Rig:
    """Return the unit box on one bone, or with `bend_segments` a column of 2 m that bends smoothly from 0.67 to 1.33 m
    about its joint at 1 m. Each of `splits` halves every edge."""
    levels, height_m = max(bend_segments, 1), 2.0 if bend_segments else 1.0
    vertices, faces = box_vertices(height_m, levels), box_faces(levels)
    for _ in range(splits):
        vertices, faces = map(torch.from_numpy, trimesh.remesh.subdivide(vertices.numpy(), faces.numpy()))
    vertices = vertices.float()
    upper = ((vertices[:, 2] - 0.66) / 0.68).clamp(0, 1) if bend_segments else torch.zeros(len(vertices))
    basis = torch.zeros(1, len(vertices), 3)
    basis[0, vertices[:, 2] == height_m, 2] = 1.0
    rig = hinged(vertices, faces, torch.tensor([[0.5, 0.5, 0.0], [0.5, 0.5, 1.0]]), ("lower", "upper"), upper)
    return dataclasses.replace(rig, shape_basis=basis)


def hinged(vertices_m: Tensor, faces: Tensor, joints_m: Tensor, names: tuple[str, ...], upper: Tensor) -> Rig:
    """Return a rig of two bones with skinning weights `upper` (V,) of the upper bone; its single shape moves
    nothing."""
    return Rig(
        vertices_m=vertices_m,
        faces=faces,
        joints_m=joints_m,
        joint_names=names,
        parents=torch.tensor([-1, 0]),
        beta=torch.zeros(1),
        beta_names=("height",),
        shape_basis=torch.zeros(1, len(vertices_m), 3),
        joint_basis=torch.zeros(1, 2, 3),
        skin_joints=torch.tensor([[0, 1]]).repeat(len(vertices_m), 1),
        skin_weights=torch.stack([1 - upper, upper], 1),
        free=torch.tensor([False, True]),
        keypoint_weights=torch.zeros(25, len(vertices_m)),
    )

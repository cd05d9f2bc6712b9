"""Reference for closest points of a body: try every triangle, and take signs from the winding number."""

import torch
import trimesh
from torch import Tensor
from trimesh.proximity import closest_point_naive
from trimesh.triangles import points_to_barycentric

from hnerf.body.descriptor import ClosestPoints


def closest_points_reference(points_m: Tensor, vertices_m: Tensor, faces: Tensor, reach_m: float) -> ClosestPoints:
    """Return the closest points on one mesh (V, 3), with signs from summed solid angles (van Oosterom and Strackee
    1983). Memory grows with points x faces."""
    mesh = trimesh.Trimesh(vertices_m, faces, process=False)
    closest_m, distance_m, face = closest_point_naive(mesh, points_m.numpy())
    barycentric = torch.from_numpy(points_to_barycentric(mesh.triangles[face], closest_m))
    angle = solid_angle(points_m[:, None], *vertices_m[faces][None].unbind(2)).sum(1)
    sign = torch.where(angle > 2 * torch.pi, -1.0, 1.0).to(points_m)
    found = torch.from_numpy(distance_m <= reach_m)
    within = torch.where(found, torch.from_numpy(face), -1)
    return ClosestPoints(within, barycentric.to(points_m), torch.where(found, sign, 1.0))


def on_surface(vertices_m: Tensor, faces: Tensor, found: ClosestPoints) -> Tensor:
    """Return the positions (N, 3) of closest points."""
    return (vertices_m[faces[found.face]] * found.barycentric[..., None]).sum(1)


def solid_angle(x: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Return the signed solid angle of triangles (..., 3) seen from x (..., 3): 4 pi in total inside a closed surface
    with outward faces."""
    a, b, c = a - x, b - x, c - x
    la, lb, lc = a.norm(dim=-1), b.norm(dim=-1), c.norm(dim=-1)
    numerator = (a * torch.linalg.cross(b, c)).sum(-1)
    denominator = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return 2 * torch.atan2(numerator, denominator)

"""Closest points of a body by trying every triangle, in plain torch, with signs by the winding number."""

import torch
from torch import Tensor

from hnerf.body.descriptor import ClosestPoints


def closest_points_reference(points_m: Tensor, vertices_m: Tensor, faces: Tensor, reach_m: float) -> ClosestPoints:
    """Return the closest points of one mesh (V, 3) by trying every triangle (Ericson, Real-Time Collision Detection,
    5.1.5), with signs by summed solid angles (van Oosterom and Strackee 1983). Memory grows with points x faces."""
    a, b, c = vertices_m[faces][None].unbind(2)  # (1, F, 3) each
    barycentric = _triangle_barycentric(points_m[:, None], a, b, c)  # (N, F, 3)
    closest = (barycentric[..., None] * torch.stack([a, b, c], 2)).sum(-2)
    distance, face = (points_m[:, None] - closest).norm(dim=-1).min(1)
    angle = solid_angle(points_m[:, None], a, b, c).sum(1)
    sign = torch.where(angle > 2 * torch.pi, -1.0, 1.0).to(points_m)
    rows = torch.arange(len(points_m), device=points_m.device)
    found = distance <= reach_m
    return ClosestPoints(torch.where(found, face, -1), barycentric[rows, face], torch.where(found, sign, 1.0))


def solid_angle(x: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Return the signed solid angle of triangles (..., 3) seen from x (..., 3): 4 pi in total inside a closed surface
    with outward faces."""
    a, b, c = a - x, b - x, c - x
    la, lb, lc = a.norm(dim=-1), b.norm(dim=-1), c.norm(dim=-1)
    numerator = (a * torch.linalg.cross(b, c)).sum(-1)
    denominator = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return 2 * torch.atan2(numerator, denominator)


def _triangle_barycentric(x: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Return barycentric coordinates of the point of each triangle closest to x, (..., 3)."""

    def edge(p: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        t = (((x - p) * (q - p)).sum(-1) / ((q - p) ** 2).sum(-1).clamp(min=1e-20)).clamp(0, 1)
        return t, ((p + t[..., None] * (q - p) - x) ** 2).sum(-1)

    normal = torch.linalg.cross(b - a, c - a)
    area_squared = (normal**2).sum(-1).clamp(min=1e-30)
    u = (torch.linalg.cross(c - b, x - b) * normal).sum(-1) / area_squared
    v = (torch.linalg.cross(a - c, x - c) * normal).sum(-1) / area_squared
    inside = torch.stack(torch.broadcast_tensors(u, v, 1 - u - v), -1)
    (ab, ab_squared), (bc, bc_squared), (ca, ca_squared) = edge(a, b), edge(b, c), edge(c, a)
    zero = torch.zeros_like(ab)
    edges = torch.stack(
        [torch.stack([1 - ab, ab, zero], -1), torch.stack([zero, 1 - bc, bc], -1), torch.stack([ca, zero, 1 - ca], -1)],
        -2,
    )
    nearest = (
        torch.stack([ab_squared, bc_squared, ca_squared], -1).argmin(-1)[..., None, None].expand(*zero.shape, 1, 3)
    )
    return torch.where((inside >= 0).all(-1, keepdim=True), inside, edges.gather(-2, nearest)[..., 0, :])

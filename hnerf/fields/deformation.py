"""Per-frame deformation: what skinning leaves unexplained, as displacements of the canonical surface
(docs/method.md)."""

import numpy as np
import torch
from torch import Tensor, nn

from hnerf.body.canonical import Descriptor, distinct_rows, weighted_sum
from hnerf.body.descriptor import vertex_normals

TINY = 1e-9  # m^2: gives nodes a width even if every vertex is a node
OVERLAP = 0.5  # width of a node's Gaussian, relative to the greatest distance of a vertex from its closest node


class FrameDeformation(nn.Module):
    """Displacements of nodes on the body in every frame; vertices follow the nodes around them.

    This is the embedded deformation of Sumner et al. 2007 without its rotations. displacement (frames + 1, nodes, 3) in
    canonical metres starts at zero; its last row is for poses that belong to no frame.
    """

    node_weights: Tensor
    normals: Tensor

    def __init__(self, vertices_m: Tensor, faces: Tensor, nodes: int, frames: int):
        """Place the nodes on the canonical body, vertices_m (V, 3) and faces (F, 3)."""
        super().__init__()
        chosen = farthest_points(vertices_m.double().cpu().numpy(), nodes)  # double: all devices choose the same
        squared = torch.cdist(vertices_m, vertices_m[chosen]).square()  # (V, nodes)
        width_squared = OVERLAP**2 * squared.amin(1).max().clamp(min=TINY)
        self.register_buffer("node_weights", torch.softmax(-squared / width_squared, 1), persistent=False)
        self.register_buffer("normals", vertex_normals(vertices_m, faces), persistent=False)
        self.displacement = nn.Parameter(torch.zeros(frames + 1, nodes, 3))

    def forward(self, described: Descriptor, frame_row: Tensor) -> tuple[Tensor, Tensor]:
        """Return the displacement (N, 3) of the surface next to described points, and its component along the normal
        (N,), in canonical metres. frame_row (N,): rows of the frames, -1 for none."""
        present, row_index = distinct_rows(frame_row, len(self.displacement))
        table = self._vertex_displacement(present).flatten(0, 1)
        corners = row_index[:, None] * len(self.node_weights) + described.corners
        found = weighted_sum(table, corners, described.barycentric)
        return found[:, :3], found[:, 3]

    @torch.no_grad()
    def average_over_frames(self, rows: Tensor) -> None:
        """Set the displacement of all other rows to the mean of `rows` (n,)."""
        others = torch.ones(len(self.displacement), dtype=torch.bool, device=rows.device)
        others[rows] = False
        self.displacement[others] = self.displacement[rows].mean(0)

    @torch.no_grad()
    def normal_displacement(self, frame_row: Tensor) -> Tensor:
        """Return the displacement of the vertices along their normals in frames `frame_row` (n,), -1 for none: (n,
        V)."""
        return self._vertex_displacement(frame_row)[..., 3]

    def _vertex_displacement(self, rows: Tensor) -> Tensor:
        """Return the displacement of the vertices for some rows of `displacement`, and its component along their
        normals: (n, V, 4)."""
        every_row = self.displacement[rows].transpose(0, 1).flatten(1)  # (nodes, 3 n), for a single matrix product
        moved = (self.node_weights @ every_row).unflatten(1, (-1, 3)).transpose(0, 1)
        return torch.cat([moved, (moved * self.normals).sum(-1, keepdim=True)], -1)


def farthest_points(points_m: np.ndarray, count: int) -> list[int]:
    """Return indices of points by farthest point sampling: the first point, then always the one farthest from those
    already chosen (Gonzalez 1985)."""
    chosen = [0]
    distance_m = np.linalg.norm(points_m - points_m[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance_m.argmax()))
        distance_m = np.minimum(distance_m, np.linalg.norm(points_m - points_m[chosen[-1]], axis=1))
    return chosen

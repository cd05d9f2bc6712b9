"""What skinning leaves over: every frame moves the canonical body's surface a little (docs/method.md)."""

import numpy as np
import torch
from torch import Tensor, nn

from hnerf.body.canonical import Descriptor, blended, occurring
from hnerf.body.descriptor import vertex_normals

TINY = 1e-9
OVERLAP = 0.5  # width of a node's reach, in the greatest distance of a vertex from its node


class FrameDeformation(nn.Module):
    """Displacements of nodes spread over the body, in every frame; vertices follow the nodes around them.

    The embedded deformation of Sumner et al. 2007 without its rotations. displacement (frames + 1, nodes, 3) in
    canonical metres starts at zero; its last row is that of a pose that no frame has.
    """

    node_weights: Tensor
    normals: Tensor

    def __init__(self, vertices_m: Tensor, faces: Tensor, nodes: int, frames: int):
        """vertices_m (V, 3), faces (F, 3): the canonical body."""
        super().__init__()
        chosen = farthest_points(vertices_m.double().cpu().numpy(), nodes)  # the same ones whatever the device
        squared = torch.cdist(vertices_m, vertices_m[chosen]).square()  # (V, nodes)
        width_squared = OVERLAP**2 * squared.amin(1).max().clamp(min=TINY)
        self.register_buffer("shares", torch.softmax(-squared / width_squared, 1), persistent=False)
        self.register_buffer("normals", vertex_normals(vertices_m, faces), persistent=False)
        self.displacement = nn.Parameter(torch.zeros(frames + 1, nodes, 3))

    def forward(self, described: Descriptor, frame_row: Tensor) -> tuple[Tensor, Tensor]:
        """How far the surface next to described points is displaced in the frames of rows `frame_row` (N,), -1 for
        none: (N, 3), and along its normal (N,); canonical metres."""
        present, row_index = occurring(frame_row, len(self.displacement))
        table = self._vertex_displacement(present).flatten(0, 1)
        found = blended(table, row_index[:, None] * len(self.node_weights) + described.corners, described.barycentric)
        return found[:, :3], found[:, 3]

    @torch.no_grad()
    def average_over_frames(self, rows: Tensor) -> None:
        """Displace all but some frames, rows (n,), as these are in the mean."""
        others = torch.ones(len(self.displacement), dtype=torch.bool, device=rows.device)
        others[rows] = False
        self.displacement[others] = self.displacement[rows].mean(0)

    @torch.no_grad()
    def normal_displacement(self, frame_row: Tensor) -> Tensor:
        """How far vertices go along their normals in the frames of rows `frame_row` (n,), -1 for none, (n, V)."""
        return self._vertex_displacement(frame_row)[..., 3]

    def _vertex_displacement(self, rows: Tensor) -> Tensor:
        """Of some rows of `displacement`, and how far that is along the vertices' normals: (n, V, 4)."""
        every_row = self.displacement[rows].transpose(0, 1).flatten(1)  # (nodes, 3 n), for one product of matrices
        moved = (self.node_weights @ every_row).unflatten(1, (-1, 3)).transpose(0, 1)
        return torch.cat([moved, (moved * self.normals).sum(-1, keepdim=True)], -1)


def farthest_points(points_m: np.ndarray, count: int) -> list[int]:
    """Indices of points far from each other: the first, then always the one farthest from those chosen before
    (Gonzalez 1985)."""
    chosen = [0]
    distance_m = np.linalg.norm(points_m - points_m[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance_m.argmax()))
        distance_m = np.minimum(distance_m, np.linalg.norm(points_m - points_m[chosen[-1]], axis=1))
    return chosen

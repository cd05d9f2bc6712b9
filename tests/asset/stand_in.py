"""An avatar without a network: the body's surface 1 cm farther out, coloured by position on the rest body."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from hnerf.avatar.avatar import Gains, Rendering
from hnerf.body.descriptor import BodyMeshes, ClosestPoints
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import pose_vertices
from hnerf.geometry.camera import Camera

CLOTHING_M = 0.01


@dataclass
class StandInAvatar:
    body: BodyFit
    queries: int = 0
    gains: Gains = field(default_factory=dict)

    def without_frames(self) -> "StandInAvatar":
        return self

    def with_body(self, body: BodyFit) -> "StandInAvatar":
        return StandInAvatar(body)

    def frame_displacements(self, points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        return points_m.new_zeros(len(theta), *points_m.shape)

    def signed_distance(self, points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        vertices_m = pose_vertices(self.body.rig, theta, root)
        found = self._closest(points_m, vertices_m)
        closest = (vertices_m[self.body.rig.faces[found.face]] * found.barycentric[..., None]).sum(1)
        self.queries += len(points_m)
        return found.sign * (points_m - closest).norm(dim=1) - CLOTHING_M

    def colour(self, points_m: Tensor, directions: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        found = self._closest(points_m, pose_vertices(self.body.rig, theta, root))
        rest = (self.body.rig.vertices_m[self.body.rig.faces[found.face]] * found.barycentric[..., None]).sum(1)
        return rest_colour(rest)

    def render(self, camera: Camera, theta: Tensor, root: Tensor) -> Rendering:
        raise NotImplementedError

    def _closest(self, points_m: Tensor, vertices_m: Tensor) -> ClosestPoints:
        only = torch.zeros(len(points_m), dtype=torch.int32)
        return BodyMeshes(vertices_m[None], self.body.rig.faces).closest_points(points_m, only, 10.0)


def rest_colour(rest_m: Tensor) -> Tensor:
    """Return a colour whose red and green grow with x and y; blue has stripes 20 cm high."""
    stripes = (torch.sin(rest_m[:, 2] * torch.pi / 0.2) > 0).float()
    return torch.stack([rest_m[:, 0] + 0.5, rest_m[:, 1] + 0.5, 0.2 + 0.6 * stripes], 1).clamp(0, 1)

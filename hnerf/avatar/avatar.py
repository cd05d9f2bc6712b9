"""The interface that a trained person offers to evaluation and export, whatever its field."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from hnerf.body.fit_result import BodyFit
from hnerf.geometry.camera import Camera

Gains = dict[str, tuple[float, float, float]]  # exposure of red, green and blue by camera, relative to a gain of 1


@dataclass(frozen=True)
class Rendering:
    """One image over black: rgb (H, W, 3) in [0, 1], premultiplied by alpha (H, W); depth_m (H, W) along the ray
    through the pixel's centre, 0 where it meets nobody."""

    rgb: Tensor
    alpha: Tensor
    depth_m: Tensor


class Avatar(Protocol):
    """A trained person; `body` holds the fine-tuned rig, shape and poses of every fitted frame.

    theta (J, 3) in radians and root (4, 4), world from body, set the pose, which need not be a fitted one.
    """

    @property
    def body(self) -> BodyFit: ...

    @property
    def gains(self) -> Gains: ...

    def without_frames(self) -> "Avatar":
        """Return the same person without what was learned for single frames, as it looks in a pose that belongs to no
        frame."""
        ...

    def with_body(self, body: BodyFit) -> "Avatar":
        """Return the same person with another body under the clothes, other poses, or both; the rig keeps its
        topology."""
        ...

    def frame_displacements(self, points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        """Return how far the surface next to points (N, 3) around the body at rest is moved by what was learned for the
        frames of poses theta (n, J, 3), root (n, 4, 4), relative to a pose that belongs to no frame: (n, N, 3), in the
        axes of the body at rest."""
        ...

    def render(self, camera: Camera, theta: Tensor, root: Tensor) -> Rendering:
        """Render colour, coverage and depth of the person alone, exposed as the training camera of this name."""
        ...

    def signed_distance(self, points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        """Return d_hat (N,) at world points (N, 3): metres to the clothed surface, negative inside."""
        ...

    def colour(self, points_m: Tensor, directions: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        """Return the radiance (N, 3) in [0, 1] at world points (N, 3) seen along unit directions (N, 3)."""
        ...

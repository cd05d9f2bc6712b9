"""What every trained model offers to evaluation and export, whatever its field."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from hnerf.body.fit_result import BodyFit
from hnerf.geometry.camera import Camera


@dataclass(frozen=True)
class Rendering:
    """One image over black. rgb (H, W, 3) in [0, 1] premultiplied by alpha (H, W); depth_m (H, W), 0 where alpha is
    0."""

    rgb: Tensor
    alpha: Tensor
    depth_m: Tensor


class Avatar(Protocol):
    """A trained person: `body` holds the fine-tuned rig, shape and poses of every fitted frame.

    theta (J, 3) radians and root (4, 4) world from body set the pose; any pose will do, not only fitted ones.
    """

    @property
    def body(self) -> BodyFit: ...

    def without_frames(self) -> "Avatar":
        """The same person without what was learned of single frames only, as it looks in a pose that no frame has."""
        ...

    def on_body(self, body: BodyFit) -> "Avatar":
        """The same person with another body under the clothes, other poses, or both; the rig keeps its topology."""
        ...

    def render(self, camera: Camera, theta: Tensor, root: Tensor) -> Rendering:
        """Colour, coverage and depth of the person alone; colour as a training camera of this name is exposed."""
        ...

    def signed_distance(self, points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        """d_hat at world points (N, 3): metres to the clothed surface, negative inside, (N,)."""
        ...

    def colour(self, points_m: Tensor, directions: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        """Radiance at world points (N, 3) seen along unit directions (N, 3), in [0, 1], (N, 3)."""
        ...

"""A trained person to be shown live: any view, frame, turn of a joint and shape, as large as the machine manages."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hnerf.avatar.avatar import Avatar
from hnerf.body.fit_result import BodyFit
from hnerf.geometry.camera import Camera
from hnerf.render.motion import Motion, select_poses
from hnerf.render.shape import transfer_poses, with_shape_values

SIDES_PX = (96, 192, 384, 768)  # longest sides of images, in the order in which they are rendered
PROMPT_S = 0.25  # an image that follows the mouse takes no longer, if the smallest allows it
KEPT_SHAPES = 8


@dataclass(frozen=True)
class Shown:
    """What to show. motion: its name; frame: one of its frames; turns_deg: for some joints by name, a turn about the
    joint's x, y and z axes in addition to the pose; shape: amounts added to shape values by name."""

    motion: str
    frame: int
    turns_deg: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    shape: Mapping[str, float] = field(default_factory=dict)


class LivePerson:
    """An avatar with the motions, by name, that it can be shown in; all of them on its own rig."""

    def __init__(self, avatar: Avatar, motions: Mapping[str, Motion]) -> None:
        self._avatar, self.motions = avatar, motions
        rig = next(iter(motions.values())).body.rig
        self._reshaped = lru_cache(KEPT_SHAPES)(lambda changes: with_shape_values(rig, dict(changes)))

    def picture(self, camera: Camera, shown: Shown) -> np.ndarray:
        """Render the person over black, (H, W, 3) uint8. Raises InputError if the shape is impossible."""
        avatar = self._avatar.with_body(self.body(shown))
        seen = avatar.render(camera, *avatar.body.pose(shown.frame))
        return (255 * seen.rgb).round().to(torch.uint8).cpu().numpy()

    def body(self, shown: Shown) -> BodyFit:
        """Return the body in the pose to show, as its only one. Raises InputError if the shape is impossible."""
        motion = self.motions[shown.motion]
        body = select_poses(motion.body, (shown.frame,))
        theta = body.theta.clone()
        for name, turn_deg in shown.turns_deg.items():
            joint = body.rig.joint_names.index(name)
            turned = Rotation.from_rotvec(theta[0, joint].numpy()) * Rotation.from_euler("xyz", turn_deg, degrees=True)
            theta[0, joint] = torch.from_numpy(turned.as_rotvec())
        body = dataclasses.replace(body, theta=theta)
        changes = tuple(sorted((name, change) for name, change in shown.shape.items() if change))
        return transfer_poses(self._reshaped(changes), body, motion.up) if changes else body


class Pace:
    """How large an image may be. Each size is tried once the one before it has taken a quarter of PROMPT_S, since it
    has four times as many pixels."""

    def __init__(self) -> None:
        self._seconds: dict[int, float] = {}

    def sides_px(self, most_px: int) -> list[int]:
        """Return the longest sides of the images to render one after another while nothing changes, the last of
        `most_px`."""
        sides = [side for side in SIDES_PX if side < most_px] + [most_px]
        prompt = [side for side in sides if self._seconds.get(side, np.inf) <= PROMPT_S]
        return [side for side in sides if not prompt or side >= max(prompt)]

    def took(self, side_px: int, seconds: float) -> None:
        """Note how long an image of this size took."""
        self._seconds[side_px] = seconds


def browser_camera(wxyz: np.ndarray, position_m: np.ndarray, fov_rad: float, aspect: float, side_px: int) -> Camera:
    """Return the camera of a browser window. wxyz: quaternion from camera to world, OpenCV axes; fov_rad: across the
    height; aspect: width / height; side_px: the longest side of the image."""
    width_px, height_px = (max(2, round(side_px * share / max(aspect, 1))) for share in (aspect, 1.0))
    focal_px = height_px / 2 / np.tan(fov_rad / 2)
    K = np.array([[focal_px, 0, (width_px - 1) / 2], [0, focal_px, (height_px - 1) / 2], [0, 0, 1]])
    R = Rotation.from_quat(wxyz, scalar_first=True).as_matrix().T
    return Camera("", K, R, -R @ position_m, width_px, height_px)


def field_of_view_rad(camera: Camera) -> float:
    """Return a camera's field of view across the height of its image."""
    return float(2 * np.arctan(camera.height_px / 2 / camera.K[1, 1]))

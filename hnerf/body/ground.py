"""A prior that the lower foot stands on the ground, at height 0, where calibrations usually put it.

With one camera, how far away somebody is follows from where he stands; from his stature alone it is off by decimetres.
"""

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Pose
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.robust import geman_mcclure
from hnerf.capture.standing import STANDING_M, stature_on_ground_m
from hnerf.geometry.camera import Camera

FEET = list(range(19, 25))  # toes and heels in BODY_25
GROUND_STD_M = 0.02  # of a keypoint of the lower foot above the ground, beyond its height on the rest body
OUTLIER_M = 0.25  # of a body in the air
MIN_CAMERA_M = 0.15  # above the ground


def is_ground(camera: Camera, keypoints: np.ndarray, up: str) -> bool:
    """Return whether world height 0 can be the ground under a person whom a single camera sees as keypoints (n, 25, 3):
    it lies below the camera, and who stands there is as tall as people are, if feet and nose are ever seen."""
    stature_m = stature_on_ground_m(camera, keypoints, up)
    low, high = STANDING_M
    above = camera.centre_m["xyz".index(up)] > MIN_CAMERA_M
    return bool(above and (np.isnan(stature_m) or low <= stature_m <= high))


class Ground:
    """A Gaussian on the height of the lowest of toes and heels, frame by frame, with Geman-McClure weights."""

    def __init__(self, up: int) -> None:
        """Prepare the prior; `up` is the index of the world's vertical axis."""
        self.up = torch.eye(3, dtype=torch.float64)[up]

    def add(
        self, equations: NormalEquations, pose: Pose, keypoints_m: Tensor, by_frame: Tensor, by_shared: Tensor
    ) -> float:
        """Add the prior to the normal equations and return its cost. keypoints_m (n, 25, 3), their derivatives by_frame
        (n, 25, 3, U) and by_shared (n, 25, 3, S)."""
        rest_m = (pose.rig.keypoint_weights[FEET] @ pose.rig.vertices_m)[:, 2] + pose.offsets_m[FEET, 2]
        height_m = keypoints_m[:, FEET] @ self.up - (rest_m - pose.rig.vertices_m[:, 2].min())
        lowest, foot = height_m.min(1)
        weight, cost = geman_mcclure(lowest.square(), GROUND_STD_M, OUTLIER_M)
        rows, feet = torch.arange(len(foot)), torch.tensor(FEET)[foot]
        equations.add_points(
            weight[:, None, None, None] * torch.outer(self.up, self.up),
            (weight * lowest)[:, None, None] * self.up,
            by_frame[rows, feet, None],
            by_shared[rows, feet, None],
        )
        return float(cost.sum())

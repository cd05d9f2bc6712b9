"""A prior that feet stand on the ground, at height 0, where calibrations usually put it.

With one camera, a person's distance follows from where they stand; stature alone leaves it decimetres off.
How far each leg reaches towards the camera follows in the same way, while its foot is down.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Pose
from hnerf.body.normal_equations import NormalEquations, geman_mcclure
from hnerf.capture.body_25 import LEFT_FOOT, RIGHT_FOOT, Body25
from hnerf.capture.standing import is_standing, stature_on_ground_m
from hnerf.geometry.camera import Camera

FEET: tuple[Body25, ...] = LEFT_FOOT + RIGHT_FOOT
GROUND_STD_M = 0.02  # of a keypoint of the lower foot above the ground, beyond its height on the rest body
OUTLIER_M = 0.25  # height of a body in the air
EACH_STD_M, EACH_OUTLIER_M = 0.04, 0.05  # the same for each foot, and height of one that swings
MIN_CAMERA_M = 0.15  # above the ground


def is_ground(camera: Camera, keypoints: np.ndarray, up: str, stature_m: float | None) -> bool:
    """Return whether world height 0 can be the ground under a person whom a single camera sees as keypoints (n, 25, 3):
    it lies below the camera, and a person standing there would have the known stature, or a usual one if it is not
    known. False if feet or nose are never seen."""
    above = camera.centre_m["xyz".index(up)] > MIN_CAMERA_M
    return bool(above) and is_standing(stature_on_ground_m(camera, keypoints, up), stature_m)


@dataclass(frozen=True)
class Ground:
    """A Gaussian on the height of the lowest toe or heel, frame by frame, with Geman-McClure weights.

    up: index of the world's vertical axis; each_foot: adds a wider one on each foot, once the pose is known well enough
    to tell a foot that swings.
    """

    up: int
    each_foot: bool = False

    def add(
        self, equations: NormalEquations, pose: Pose, keypoints_m: Tensor, by_frame: Tensor, by_shared: Tensor
    ) -> float:
        """Add the prior to the normal equations and return its cost. keypoints_m (n, 25, 3), their derivatives by_frame
        (n, 25, 3, U) and by_shared (n, 25, 3, S).

        Heights on the rest body are held fixed in each step, although shape and offsets change them: with their
        derivatives, limbs are less accurate (docs/experiments.md, body fit).
        """
        rest_m = (pose.rig.keypoint_weights @ pose.rig.vertices_m)[:, 2] + pose.offsets_m[:, 2]
        up = torch.eye(3, dtype=keypoints_m.dtype)[self.up]
        height_m = keypoints_m @ up - (rest_m - pose.rig.vertices_m[:, 2].min())
        rows, cost = torch.arange(len(height_m)), 0.0
        parts = [(FEET, GROUND_STD_M, OUTLIER_M)]
        parts += [(foot, EACH_STD_M, EACH_OUTLIER_M) for foot in (LEFT_FOOT, RIGHT_FOOT)] if self.each_foot else []
        for points, std_m, outlier_m in parts:
            lowest, at = height_m[:, points].min(1)
            weight, costs = geman_mcclure(lowest.square(), std_m, outlier_m)
            point = torch.tensor(points)[at]
            equations.add_points(
                weight[:, None, None, None] * torch.outer(up, up),
                (weight * lowest)[:, None, None] * up,
                by_frame[rows, point, None],
                by_shared[rows, point, None],
            )
            cost += float(costs.sum())
        return cost

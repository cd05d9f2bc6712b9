"""A prior on how far one end of a limb lies behind the other: one view hardly distinguishes a limb bent towards it from
one bent away, but a network's metric landmarks do."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hnerf.body.normal_equations import NormalEquations, geman_mcclure
from hnerf.body.observations import Observations
from hnerf.capture.body_25 import LEFT_ARM, LEFT_LEG, RIGHT_ARM, RIGHT_LEG, Body25
from hnerf.capture.capture import Capture
from hnerf.capture.keypoint_sets import SETS
from hnerf.detection.merge import nearest_person

# Error of the depth between two landmarks, against the truth: 45 to 130 mm, bias included, on two rendered recordings.
DEPTH_STD_M, OUTLIER_M = 0.1, 0.3

# Limbs from the trunk, hips, shoulders. The trunk is left out: the network sees it lean back by a decimetre.
LIMBS = (
    *RIGHT_ARM, *LEFT_ARM, *RIGHT_LEG, *LEFT_LEG,
    (Body25.R_HIP, Body25.L_HIP), (Body25.R_SHOULDER, Body25.L_SHOULDER),
)  # fmt: skip


@dataclass(frozen=True)
class LimbDepths:
    """Depths of limbs as a network saw them, of the second end behind the first: depth_m and trust (n, 10) in the order
    of LIMBS; away (n, 3): unit directions from the camera to the person."""

    depth_m: Tensor
    trust: Tensor
    away: Tensor

    def add(self, equations: NormalEquations, keypoints_m: Tensor, by_frame: Tensor, by_shared: Tensor) -> float:
        """Add the prior to the normal equations and return its cost. keypoints_m (n, 25, 3), their derivatives by_frame
        (n, 25, 3, U) and by_shared (n, 25, 3, S)."""
        first, second = (list(ends) for ends in zip(*LIMBS, strict=True))
        limb_m = keypoints_m[:, second] - keypoints_m[:, first]
        off_m = (limb_m * self.away[:, None]).sum(-1) - self.depth_m
        weight, cost = geman_mcclure(off_m.square(), DEPTH_STD_M, OUTLIER_M)
        weight = weight * self.trust
        along = self.away[:, None, :, None] * self.away[:, None, None]  # (n, 1, 3, 3)
        equations.add_points(
            weight[..., None, None] * along,
            (weight * off_m)[..., None] * self.away[:, None],
            by_frame[:, second] - by_frame[:, first],
            by_shared[:, second] - by_shared[:, first],
        )
        return float((cost * self.trust).sum())


def observe_limb_depths(capture: Capture, observations: Observations) -> LimbDepths | None:
    """Return the depths of limbs from the only training camera's landmarks; None if no network was run, or with several
    cameras, which see depth themselves."""
    found = capture.landmarks(capture.train_cameras[0])
    if found is None or len(capture.train_cameras) > 1:
        return None
    own = sorted({end for limb in LIMBS for end in limb})
    places = [SETS["blazepose_33"].rows[keypoint][0] for keypoint in own]
    pixels, metres = (points[:, :, places] for points in found)
    keypoints = observations.keypoints(0)[:, own]
    depths_m, trust = np.zeros((2, len(keypoints), len(LIMBS)))
    ends = np.array([[own.index(end) for end in limb] for limb in LIMBS])
    for t, subject in enumerate(keypoints):
        person = nearest_person(subject, pixels[t])
        if person is not None:
            depth_m, seen = metres[t, person, :, 2], pixels[t, person, :, 2]
            depths_m[t] = depth_m[ends[:, 1]] - depth_m[ends[:, 0]]
            trust[t] = np.minimum(seen[ends[:, 0]], seen[ends[:, 1]])
    shown = np.where(keypoints[..., 2:] > 0, 1.0, 0.0)
    middle = (keypoints[..., :2] * shown).sum(1) / shown.sum(1).clip(1)
    _, away = observations.cameras[0].rays(middle)
    return LimbDepths(*(torch.from_numpy(part) for part in (depths_m, trust, away)))

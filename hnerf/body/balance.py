"""A prior that keeps the centre of mass above the feet.

One image hardly distinguishes a body that leans towards the camera from an upright one that is smaller. Several cameras
see the difference, so the prior is used with one camera only.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from hnerf.body.normal_equations import NormalEquations, geman_mcclure
from hnerf.capture.body_25 import Body25

BALANCE_M = 0.05  # standard deviation
OUTLIER_M = 0.15  # distance in a step or a jump, where the prior lets go

# Shares of the body's mass (Winter 2009, table 4.1) by BODY_25 keypoint: half of a segment's share at either end, all
# of an arm's at its elbow.
TRUNK = {Body25.NECK: 0.289, Body25.MID_HIP: 0.289}  # with the head
ARMS = {Body25.R_ELBOW: 0.05, Body25.L_ELBOW: 0.05}
THIGHS = {Body25.R_HIP: 0.05, Body25.L_HIP: 0.05, Body25.R_KNEE: 0.05, Body25.L_KNEE: 0.05}
SHANKS = {Body25.R_KNEE: 0.0305, Body25.L_KNEE: 0.0305, Body25.R_ANKLE: 0.0305, Body25.L_ANKLE: 0.0305}  # with feet
SUPPORT = {Body25.R_ANKLE: 0.5, Body25.L_ANKLE: 0.5}  # judged by keypoints, the trunk stands above them


def centre_of_mass_over_feet() -> Tensor:
    """Return keypoint coefficients (25,), summing to 0, that give the centre of mass minus the midpoint of the
    ankles."""
    shares = torch.zeros(25, dtype=torch.float64)
    for segment in (TRUNK, ARMS, THIGHS, SHANKS):
        for keypoint, share in segment.items():
            shares[keypoint] += share
    shares /= shares.sum()
    for keypoint, share in SUPPORT.items():
        shares[keypoint] -= share
    return shares


@dataclass(frozen=True)
class Balance:
    """A prior on the horizontal distance of the centre of mass from the midpoint of the ankles, with a standard
    deviation of 5 cm in either direction; Geman-McClure weights release it in a step or a jump. up: index of the
    world's vertical axis."""

    up: int

    def add(self, equations: NormalEquations, keypoints_m: Tensor, jacobian: Tensor) -> float:
        """Add the prior to the normal equations and return its cost. keypoints_m (n, 25, 3), jacobian (n, 25, 3, U).

        Shared unknowns are left alone: nobody keeps their balance by changing shape.
        """
        shares, level = centre_of_mass_over_feet(), [axis for axis in range(3) if axis != self.up]
        off, by_frame = (torch.einsum("k,nkc...->nc...", shares, t)[:, level] for t in (keypoints_m, jacobian))
        weight, cost = geman_mcclure(off.square().sum(-1), BALANCE_M, OUTLIER_M)
        weighted = weight[:, None, None] * by_frame
        equations.frame[0] += (weighted.mT @ by_frame).numpy()
        equations.frame_gradient += torch.einsum("ncu,nc->nu", weighted, off).numpy()
        return float(cost.sum())

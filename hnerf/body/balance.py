"""Where a person's weight is: one image hardly tells a body that leans towards its camera from an upright one that is
smaller. Several cameras see this, so it is asked of one camera only."""

import torch
from torch import Tensor

from hnerf.body.normal_equations import NormalEquations
from hnerf.body.robust import geman_mcclure

BALANCE_M = 0.05
FADES_M = 0.15  # from where the pull fades: a step or a jump

# Shares of the body's mass (Winter 2009, table 4.1), half at either end of a segment, arms at the elbows: BODY_25
# keypoint and share.
TRUNK = {1: 0.289, 8: 0.289}  # head and trunk: neck and middle of the hips
ARMS = {3: 0.05, 6: 0.05}  # elbows
THIGHS = {9: 0.05, 12: 0.05, 10: 0.05, 13: 0.05}  # hips and knees
SHANKS = {10: 0.0305, 13: 0.0305, 11: 0.0305, 14: 0.0305}  # knees and ankles, with the feet
SUPPORT = {11: 0.5, 14: 0.5}  # ankles: where keypoints put the trunk's middle line, it stands above them


def centre_of_mass_over_feet() -> Tensor:
    """Coefficients (25,) of the keypoints, which sum to 0: the centre of mass less the middle of the ankles."""
    shares = torch.zeros(25, dtype=torch.float64)
    for segment in (TRUNK, ARMS, THIGHS, SHANKS):
        for keypoint, share in segment.items():
            shares[keypoint] += share
    shares /= shares.sum()
    for keypoint, share in SUPPORT.items():
        shares[keypoint] -= share
    return shares


class Balance:
    """The centre of mass is above the middle of the ankles, give or take 5 cm either way, except when it is not:
    Geman-McClure lets a step or a jump go."""

    def __init__(self, up: int) -> None:
        """up: index of the world's vertical axis."""
        self.level = [axis for axis in range(3) if axis != up]
        self.shares = centre_of_mass_over_feet()

    def add(self, equations: NormalEquations, keypoints_m: Tensor, jacobian: Tensor) -> float:
        """keypoints_m (n, 25, 3), jacobian (n, 25, 3, U); returns the cost. Shared unknowns are left alone: nobody
        keeps the balance by another shape."""
        off, by_frame = (
            torch.einsum("k,nkc...->nc...", self.shares, t)[:, self.level] for t in (keypoints_m, jacobian)
        )
        weight, cost = geman_mcclure(off.square().sum(-1), BALANCE_M, FADES_M)
        weighted = weight[:, None, None] * by_frame
        equations.frame[0] += (weighted.mT @ by_frame).numpy()
        equations.frame_gradient += torch.einsum("ncu,nc->nu", weighted, off).numpy()
        return float(cost.sum())

"""The body models that a fit can use: a rig for any shape, and a prior on shapes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from hnerf.body.anny import ADULT, BETA_HIGH, BETA_LOW, LOCAL_CHANGES, PHENOTYPES, anny_rig
from hnerf.body.rig import Rig
from hnerf.body.smpl import BETAS, T_POSE_BONES, read_smpl, rest_rotations
from hnerf.config import FitSettings

SHAPED = ("vertices_m", "joints_m", "beta", "shape_basis", "joint_basis")  # what in a rig depends on its shape
PHENOTYPE_STD, LOCAL_CHANGE_STD = 0.25, 0.3  # of anny's shape values
SMPL_BETA_LIMIT = 5.0  # standard deviations


@dataclass(frozen=True)
class BodyModel:
    """A body model and its shape prior.

    `rig(beta)`: the rig, float64, linearised at this shape; at the mean shape for None. The prior on beta is a Gaussian
    with `mean` and `std`, truncated at `low` and `high`; `details` (bool) marks values that keypoints alone hardly
    determine; all (B,). `rest_rotations` (J, 3, 3): from SMPL's T pose to the rig's rest pose, body frame, for poses
    given as SMPL's parameters; `is_smpl`: whether the betas of given poses also apply to this rig.
    """

    rig: Callable[[Tensor | None], Rig]
    mean: Tensor
    std: Tensor
    low: Tensor
    high: Tensor
    details: Tensor
    rest_rotations: Tensor
    is_smpl: bool


def body_model(settings: FitSettings) -> BodyModel:
    """Return the model that the settings name. Raises InputError if its file is missing or holds no known model."""
    return _anny() if settings.body_model == "anny" else _smpl(settings)


def _anny() -> BodyModel:
    average = anny_rig().to(dtype=torch.float64)

    def rig(beta: Tensor | None) -> Rig:
        shaped = anny_rig(beta)
        return replace(average, **{name: getattr(shaped, name).double() for name in SHAPED})

    std = [PHENOTYPE_STD] * len(PHENOTYPES) + [LOCAL_CHANGE_STD] * len(LOCAL_CHANGES)
    mean, stds, low, high = (torch.tensor(v, dtype=torch.float64) for v in (ADULT, std, BETA_LOW, BETA_HIGH))
    details = torch.arange(len(ADULT)) >= len(PHENOTYPES)
    rest = rig(None)
    rotations = rest_rotations(rest.joint_names, rest.parents.tolist(), T_POSE_BONES)
    return BodyModel(rig, mean, stds, low, high, details, rotations, is_smpl=False)


def _smpl(settings: FitSettings) -> BodyModel:
    smpl = read_smpl(Path(settings.body_model).resolve())

    def rig(beta: Tensor | None) -> Rig:
        return smpl.rig if beta is None else smpl.rig.reshaped(beta)

    zero, one = torch.zeros(BETAS, dtype=torch.float64), torch.ones(BETAS, dtype=torch.float64)
    limit = SMPL_BETA_LIMIT * one
    return BodyModel(rig, zero, one, -limit, limit, zero.bool(), smpl.rest_rotations, is_smpl=True)

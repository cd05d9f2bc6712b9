"""The body models a fit can use, each as a rig for any shape and what is known of shapes beforehand."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from hnerf.body.anny import ADULT, BETA_HIGH, BETA_LOW, LOCAL_CHANGES, PHENOTYPES, anny_rig
from hnerf.body.rig import Rig
from hnerf.body.smpl import BETAS, T_POSE_BONES, read_smpl, rest_turns
from hnerf.config import FitSettings

SMPL_BETA_LIMIT = 5.0  # standard deviations


@dataclass(frozen=True)
class BodyModel:
    """`rig(beta or None)`: float64, linearised at a shape, the mean one for None. Shapes are likely to be at `mean`,
    with standard deviations `spread`, and never below `low` or above `high`; `details` (bool): values of which
    keypoints alone say little; all (B,).

    Where SMPL's own parameters are given: `rest_turns` (J, 3, 3) from SMPL's T pose to the rig's rest pose, body frame;
    `is_smpl`: betas too are the rig's own.
    """

    rig: Callable[[Tensor | None], Rig]
    mean: Tensor
    spread: Tensor
    low: Tensor
    high: Tensor
    details: Tensor
    rest_turns: Tensor
    is_smpl: bool


def body_model(settings: FitSettings) -> BodyModel:
    """The model that the settings name. Raises InputError where its file is missing or is none that is known."""
    return _anny(settings) if settings.body_model == "anny" else _smpl(settings)


def _anny(settings: FitSettings) -> BodyModel:
    def rig(beta: Tensor | None) -> Rig:
        return anny_rig(beta).to(dtype=torch.float64)

    spread = [settings.phenotype_std] * len(PHENOTYPES) + [settings.local_change_std] * len(LOCAL_CHANGES)
    mean, spreads, low, high = (torch.tensor(v, dtype=torch.float64) for v in (ADULT, spread, BETA_LOW, BETA_HIGH))
    details = torch.arange(len(ADULT)) >= len(PHENOTYPES)
    rest = rig(None)
    turns = rest_turns(rest.joint_names, rest.parents.tolist(), T_POSE_BONES)
    return BodyModel(rig, mean, spreads, low, high, details, turns, is_smpl=False)


def _smpl(settings: FitSettings) -> BodyModel:
    smpl = read_smpl(Path(settings.body_model).resolve())

    def rig(beta: Tensor | None) -> Rig:
        return smpl.rig if beta is None else smpl.rig.reshaped(beta)

    zero, one = torch.zeros(BETAS, dtype=torch.float64), torch.ones(BETAS, dtype=torch.float64)
    limit = SMPL_BETA_LIMIT * one
    return BodyModel(rig, zero, one, -limit, limit, zero.bool(), smpl.rest_turns, is_smpl=True)

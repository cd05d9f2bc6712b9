"""The same avatar on another body: shape values changed, or more or less volume."""

from collections.abc import Mapping

import numpy as np
import torch
import trimesh
from scipy.optimize import brentq
from torch import Tensor

from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig
from hnerf.errors import CaptureError
from hnerf.render.motion import lifted, lowest_points_m

FOLDED_SHARE = 0.005  # of the triangles that may turn over before a shape is refused; half a per cent is not seen
STEP, FARTHEST = 0.25, 3.0  # changes of the weight value that are tried; its own range is 1
VOLUME_VALUE = "weight"


def with_values(rig: Rig, changes: Mapping[str, float]) -> Rig:
    """The rig with these amounts added to shape values of these names, to first order around the fitted shape.

    Raises CaptureError for a value that the rig has not, and where the skin would fold over.
    """
    beta = rig.beta.clone()
    for name, change in changes.items():
        if name not in rig.beta_names:
            raise CaptureError(f"shape {name}: this body's values are {', '.join(rig.beta_names)}")
        beta[rig.beta_names.index(name)] += change
    shaped = rig.reshaped(beta)
    upright = (_normals(shaped) * _normals(rig)).sum(1) >= 0  # not so where a value is not a number
    folded = float((~upright).float().mean())
    if folded > FOLDED_SHARE:
        told = ", ".join(f"{name} {change:+.2f}" for name, change in changes.items())
        raise CaptureError(f"shape {told}: folds {100 * folded:.1f} % of the skin over; ask for a smaller change")
    return shaped


def with_volume(rig: Rig, change: float) -> Rig:
    """The rig at rest with another volume, by its value for weight: -0.4 is 40 % less.

    Raises CaptureError where the rig has no such value, or the change is out of its reach.
    """
    wanted_m3 = (1 + change) * volume_m3(rig)
    weight = torch.tensor([name == VOLUME_VALUE for name in rig.beta_names])
    if not weight.any():
        raise CaptureError(f"volume: this body has no shape value {VOLUME_VALUE}; change its shape values instead")

    def missing_m3(amount: float) -> float:
        return volume_m3(rig.reshaped(rig.beta + amount * weight)) - wanted_m3

    amounts = np.copysign(np.arange(STEP, FARTHEST + STEP, STEP), change)
    enough = next((float(amount) for amount in amounts if missing_m3(0.0) * missing_m3(float(amount)) <= 0), None)
    if enough is None:
        raise CaptureError(f"volume {100 * change:+.0f} %: out of this body's reach; ask for a smaller change")
    return with_values(rig, {VOLUME_VALUE: brentq(missing_m3, 0.0, enough, xtol=1e-4)})


def volume_m3(rig: Rig) -> float:
    """Volume of the body at rest."""
    return float(trimesh.Trimesh(rig.vertices_m.numpy(), rig.faces.numpy(), process=False).volume)


def worn_by(rig: Rig, body: BodyFit, up: str) -> BodyFit:
    """The poses of `body` on a reshaped rig, every lowest point as high as before along the world's axis `up`."""
    return lifted(BodyFit(rig, body.frames, body.theta, body.root), lowest_points_m(body, up), up)


def _normals(rig: Rig) -> Tensor:
    a, b, c = rig.vertices_m[rig.faces].unbind(1)
    return torch.linalg.cross(b - a, c - a)

"""The same avatar on another body: shape values changed, or more or less volume."""

import dataclasses
from collections.abc import Mapping

import torch
import trimesh
from scipy.optimize import brentq
from torch import Tensor

from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig
from hnerf.errors import InputError
from hnerf.render.motion import lifted, lowest_points_m

FOLDED_SHARE = 0.005  # of the triangles that may turn over before a shape is refused; half a per cent is not seen
THICKER = -0.9, 2.0  # shares of the way from the bones to the skin that may be added
AS_THICK = "neck", "wrist", "foot"  # in names of joints whose parts, with all below them, stay: head, hands, feet


def with_values(rig: Rig, changes: Mapping[str, float]) -> Rig:
    """The rig with these amounts added to shape values of these names, to first order around the fitted shape.

    Raises InputError for a value that the rig has not, and where the skin would fold over.
    """
    beta = rig.beta.clone()
    for name, change in changes.items():
        if name not in rig.beta_names:
            raise InputError(f"shape {name}: this body's values are {', '.join(rig.beta_names)}")
        beta[rig.beta_names.index(name)] += change
    message = ", ".join(f"{name} {change:+.2f}" for name, change in changes.items())
    return _unfolded(rig.reshaped(beta), rig, f"shape {message}")


def with_volume(rig: Rig, change: float) -> Rig:
    """The rig with another volume at rest: -0.4 is 40 % less. Trunk and limbs get thicker or thinner about their bones.

    Raises InputError where the change is out of reach, and where the skin would fold over.
    """
    wanted_m3, outwards_m = (1 + change) * volume_m3(rig), outwards(rig)

    def thicker(share: float) -> Rig:
        return dataclasses.replace(rig, vertices_m=rig.vertices_m + share * outwards_m)

    def missing_m3(share: float) -> float:
        return volume_m3(thicker(share)) - wanted_m3

    message = f"volume {100 * change:+.0f} %"
    if not missing_m3(THICKER[0]) < 0 < missing_m3(THICKER[1]):
        raise InputError(f"{message}: out of this body's reach; ask for a smaller change")
    return _unfolded(thicker(brentq(missing_m3, *THICKER, xtol=1e-4)), rig, message)


def outwards(rig: Rig) -> Tensor:
    """(V, 3) metres: from the nearest points of the bones that carry a vertex to it, blended by its skin weights; zero
    for head, hands and feet. A bone reaches from its joint to the joints below."""
    moved_m, parents, stays = torch.zeros_like(rig.vertices_m), rig.parents.tolist(), set()
    for joint, parent in enumerate(parents):
        if parent in stays or any(part in rig.joint_names[joint] for part in AS_THICK):
            stays.add(joint)
            continue
        start_m = rig.joints_m[joint]
        ends_m = torch.stack([start_m, *(rig.joints_m[j] for j, above in enumerate(parents) if above == joint)])
        along_m, from_start_m = ends_m - start_m, rig.vertices_m - start_m
        share = from_start_m @ along_m.T / (along_m**2).sum(1).clamp(min=1e-12)  # (V, bones)
        away_m = from_start_m[:, None] - share.clamp(0, 1)[..., None] * along_m
        nearest = away_m.norm(dim=2).argmin(1)
        weight = (rig.skin_weights * (rig.skin_joints == joint)).sum(1, keepdim=True)
        moved_m += weight * away_m[torch.arange(len(away_m)), nearest]
    return moved_m


def volume_m3(rig: Rig) -> float:
    """Volume of the body at rest."""
    return float(trimesh.Trimesh(rig.vertices_m.numpy(), rig.faces.numpy(), process=False).volume)


def worn_by(rig: Rig, body: BodyFit, up: str) -> BodyFit:
    """The poses of `body` on a reshaped rig, every lowest point as high as before along the world's axis `up`."""
    return lifted(BodyFit(rig, body.frames, body.theta, body.root), lowest_points_m(body, up), up)


def _unfolded(shaped: Rig, rig: Rig, message: str) -> Rig:
    """`shaped`; InputError, after `message`, if too much of its skin has turned over."""
    upright = (_normals(shaped) * _normals(rig)).sum(1) >= 0  # not so where a value is not a number
    folded = float((~upright).float().mean())
    if folded > FOLDED_SHARE:
        raise InputError(f"{message}: folds {100 * folded:.1f} % of the skin over; ask for a smaller change")
    return shaped


def _normals(rig: Rig) -> Tensor:
    a, b, c = rig.vertices_m[rig.faces].unbind(1)
    return torch.linalg.cross(b - a, c - a)

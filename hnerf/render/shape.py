"""Body shape editing: the avatar's rig with changed shape values or another volume."""

import dataclasses
from collections.abc import Mapping

import torch
import trimesh
from scipy.optimize import brentq
from torch import Tensor

from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig
from hnerf.errors import InputError
from hnerf.render.motion import lowest_points_m, middle_of_hips_m, set_lowest_points, set_middle_of_hips

MAX_FOLDED_SHARE = 0.005  # of the triangles; half a per cent turned over is not visible
THICKNESS_RANGE = -0.9, 2.0  # allowed change of thickness, as a share of the distance from bone to skin
# Head, hands and feet: the skin of joints whose names contain these, and of all joints below, keeps its thickness.
UNSCALED_PARTS = "neck", "wrist", "foot"


def with_shape_values(rig: Rig, changes: Mapping[str, float]) -> Rig:
    """Return the rig with the named shape values changed by these amounts, to first order around the fitted shape.

    Raises InputError if the rig has no such value, or if the skin would fold over.
    """
    beta = rig.beta.clone()
    for name, change in changes.items():
        if name not in rig.beta_names:
            raise InputError(f"--shape {name}: no such value; this body's are {', '.join(rig.beta_names)}")
        beta[rig.beta_names.index(name)] += change
    title = ", ".join(f"{name} {change:+.2f}" for name, change in changes.items())
    return _require_unfolded(rig.reshaped(beta), rig, f"shape {title}")


def with_volume(rig: Rig, change: float) -> Rig:
    """Return the rig with its volume at rest changed by a share: -0.4 is 40 % less. Trunk and limbs get thicker or
    thinner about their bones.

    Raises InputError if no thickness gives that volume, or if the skin would fold over.
    """
    wanted_m3, offsets_m = (1 + change) * volume_m3(rig), offsets_from_bones_m(rig)

    def thicker(share: float) -> Rig:
        return dataclasses.replace(rig, vertices_m=rig.vertices_m + share * offsets_m)

    def missing_m3(share: float) -> float:
        return volume_m3(thicker(share)) - wanted_m3

    title = f"volume {100 * change:+.0f} %"
    if not missing_m3(THICKNESS_RANGE[0]) < 0 < missing_m3(THICKNESS_RANGE[1]):
        raise InputError(f"{title}: cannot be reached with this body; ask for a smaller change")
    return _require_unfolded(thicker(brentq(missing_m3, *THICKNESS_RANGE, xtol=1e-4)), rig, title)


def offsets_from_bones_m(rig: Rig) -> Tensor:
    """Return each vertex's offset (V, 3) in metres from the nearest points on the bones that carry it, blended by its
    skin weights; zero on head, hands and feet. A bone reaches from its joint to the joint's children."""
    moved_m, parents, stays = torch.zeros_like(rig.vertices_m), rig.parents.tolist(), set()
    for joint, parent in enumerate(parents):
        if parent in stays or any(part in rig.joint_names[joint] for part in UNSCALED_PARTS):
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
    """Return the volume of the body at rest."""
    return float(trimesh.Trimesh(rig.vertices_m.numpy(), rig.faces.numpy(), process=False).volume)


def transfer_poses(rig: Rig, body: BodyFit, up: str) -> BodyFit:
    """Return the poses of `body` on a reshaped rig: the hips stay where they are, except that each pose is shifted
    along the world's axis `up` so that its lowest point is as high as before."""
    reshaped = set_middle_of_hips(dataclasses.replace(body, rig=rig), middle_of_hips_m(body))
    return set_lowest_points(reshaped, lowest_points_m(body, up), up)


def _require_unfolded(shaped: Rig, rig: Rig, title: str) -> Rig:
    """Return `shaped`; raise InputError, starting with `title`, if too many of its triangles have turned over."""
    upright = (_normals(shaped) * _normals(rig)).sum(1) >= 0  # False where a value is NaN
    folded = float((~upright).float().mean())
    if folded > MAX_FOLDED_SHARE:
        raise InputError(f"{title}: folds {100 * folded:.1f} % of the skin over; ask for a smaller change")
    return shaped


def _normals(rig: Rig) -> Tensor:
    a, b, c = rig.vertices_m[rig.faces].unbind(1)
    return torch.linalg.cross(b - a, c - a)

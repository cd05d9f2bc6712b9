"""SMPL (Loper et al. 2015), SMPL-H (Romero et al. 2017) and SMPL-X (Pavlakos et al. 2019) as a Rig, from a model file
that the user provides; none is shipped.

Joints that anny also has take anny's names, so that pose priors and exports know them. The rest pose is also anny's,
arms and knees a little bent, because pose priors, hinges and the start of a fit refer to it: SMPL's T pose would leave
hinges without an axis. Pose blend shapes (`posedirs`) are evaluated once, for that rest pose; in other poses the rig
has none, so bent joints are less full than SMPL's own. Fingers, toes, jaw and eyes are locked. Expressions are left
out.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from hnerf.body.rig import Rig, shortest_rotation
from hnerf.capture.safe_io import ARRAY_FILE_ERRORS, read_arrays
from hnerf.capture.safe_pickle import MAX_BYTES, read_pickle
from hnerf.errors import InputError, raise_if_unreachable
from hnerf.geometry.axes import Z_UP_FROM_Y_UP

BETAS = 10
BODY_FROM_SMPL = torch.from_numpy(Z_UP_FROM_Y_UP)
KEYS = ("v_template", "f", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table")
SKINNED = 8  # joints that a vertex may follow

# SMPL's joints 0 to 21, which all its variants share, by the names of anny's joints in the same place.
JOINTS = (
    "root", "upperleg01.L", "upperleg01.R", "spine05", "lowerleg01.L", "lowerleg01.R", "spine03", "foot.L", "foot.R",
    "spine01", "toes.L", "toes.R", "neck01", "clavicle.L", "clavicle.R", "head", "upperarm01.L", "upperarm01.R",
    "lowerarm01.L", "lowerarm01.R", "wrist.L", "wrist.R",
)  # fmt: skip
LOCKED = ("root", "toes.L", "toes.R")
_FINGERS = tuple(f"finger{k:02d}.{side}" for side in "LR" for k in range(15))
FURTHER_JOINTS = {24: ("hand.L", "hand.R"), 52: _FINGERS, 55: ("jaw", "eye.L", "eye.R", *_FINGERS)}

# Directions of the left limbs' bones in anny's rest pose, body frame; the right side mirrors them.
REST_BONES = {
    "upperarm01": (0.67, -0.03, -0.74),
    "lowerarm01": (0.51, -0.68, -0.52),
    "upperleg01": (0.08, -0.08, -0.99),
    "lowerleg01": (0.10, 0.07, -0.99),
}
# The same in the T pose of the mean SMPL body, rounded.
T_POSE_BONES = {
    f"{bone}.{side}": torch.tensor([sign * x, y, z], dtype=torch.float64)
    for side, sign in (("L", 1), ("R", -1))
    for bone, (x, y, z) in {
        "upperarm01": (1.0, 0.0, 0.0),
        "lowerarm01": (1.0, 0.0, 0.0),
        "upperleg01": (0.1, 0.0, -1.0),
        "lowerleg01": (-0.04, 0.09, -1.0),
    }.items()
}
BONE_ENDS = {"upperarm01": "lowerarm01", "lowerarm01": "wrist", "upperleg01": "lowerleg01", "lowerleg01": "foot"}

# BODY_25 keypoints as the mean of joints, or as a vertex on the skin: its index in SMPL's and SMPL-H's mesh, and in
# SMPL-X's, as in the smplx package's vertex_ids.
BODY_25: tuple[tuple[str, ...] | tuple[int, int], ...] = (
    (332, 9120), ("upperarm01.L", "upperarm01.R"), ("upperarm01.R",), ("lowerarm01.R",), ("wrist.R",),
    ("upperarm01.L",), ("lowerarm01.L",), ("wrist.L",), ("upperleg01.L", "upperleg01.R"), ("upperleg01.R",),
    ("lowerleg01.R",), ("foot.R",), ("upperleg01.L",), ("lowerleg01.L",), ("foot.L",), (6260, 9929), (2800, 9448),
    (4071, 616), (583, 6), (3216, 5770), (3226, 5780), (3387, 8846), (6617, 8463), (6624, 8474), (6787, 8635),
)  # fmt: skip
MESHES = {6890: 0, 10475: 1}  # by number of vertices: which index of such a pair to use


@dataclass(frozen=True)
class Smpl:
    """An SMPL model: rig at betas 0, float64; rest_rotations (J, 3, 3): each bone's rotation from SMPL's T pose to the
    rig's rest pose, body frame."""

    rig: Rig
    rest_rotations: Tensor


def read_smpl(path: Path) -> Smpl:
    """Read the model in a .npz or .pkl file. Raises InputError if the file is missing or holds no SMPL, SMPL-H or
    SMPL-X model."""
    data = _checked(path, _read(path))
    weights, regressor = data["weights"], data["J_regressor"]
    count, joints = weights.shape
    names = JOINTS + FURTHER_JOINTS[joints]
    parents = [-1, *data["kintree_table"][0, 1:].long().tolist()]
    vertices_m = torch.cat([data["v_template"][None], data["shapedirs"][..., :BETAS].permute(2, 0, 1)])
    vertices_m = vertices_m @ BODY_FROM_SMPL.T  # (1 + 10, V, 3): template, then shapes
    joints_m = regressor @ vertices_m
    rotations = rest_rotations(names, parents, _bones(names, joints_m[0]))
    vertices_m[0] += _pose_blend_shape(data["posedirs"], rotations, parents)
    vertices_m, joints_m = _reposed(vertices_m, joints_m, weights, rotations, parents)

    of_body = torch.tensor([not name.startswith("eye") for name in names])  # eyeballs are separate parts
    kept = of_body[weights.argmax(1)]
    place = kept.cumsum(0) - 1
    faces = data["f"].long()
    faces = place[faces[kept[faces].all(1)]]
    keypoint_weights = _moved_off(_keypoint_weights(names, regressor, MESHES[count]), vertices_m[0], kept)
    top = weights[kept].topk(min(SKINNED, joints), 1)
    rig = Rig(
        vertices_m=vertices_m[0, kept],
        faces=faces,
        joints_m=joints_m[0],
        joint_names=names,
        parents=torch.tensor(parents),
        beta=torch.zeros(BETAS, dtype=torch.float64),
        beta_names=tuple(f"beta{k}" for k in range(BETAS)),
        shape_basis=vertices_m[1:, kept],
        joint_basis=joints_m[1:],
        skin_joints=top.indices,
        skin_weights=top.values / top.values.sum(1, keepdim=True),
        free=torch.tensor([name in JOINTS and name not in LOCKED for name in names]),
        keypoint_weights=keypoint_weights,
    )
    if not all(part.isfinite().all() for part in (rig.vertices_m, rig.skin_weights, rig.keypoint_weights)):
        raise InputError(f"{path}: a bone, a row of weights or of J_regressor is zero; convert the model again")
    return Smpl(rig, rotations)


def rest_rotations(names: tuple[str, ...], parents: list[int], t_pose: dict[str, Tensor]) -> Tensor:
    """Return each bone's rotation (J, 3, 3), body frame, from SMPL's T pose, with bone directions t_pose by joint, to
    anny's rest pose: limbs take the shortest rotation, feet and trunk do not rotate, all other bones follow their
    parent."""
    rotations: list[Tensor] = []
    for name, parent in zip(names, parents, strict=True):
        above = rotations[parent] if parent >= 0 else torch.eye(3, dtype=torch.float64)
        limb, _, side = name.partition(".")
        if limb in REST_BONES:
            mirror = torch.tensor([1.0 if side == "L" else -1.0, 1, 1], dtype=torch.float64)
            target = torch.tensor(REST_BONES[limb], dtype=torch.float64) * mirror
            above = shortest_rotation(above @ t_pose[name], target) @ above
        rotations.append(torch.eye(3, dtype=torch.float64) if limb == "foot" else above)
    return torch.stack(rotations)


def _read(path: Path) -> dict[str, Any]:
    """Read the arrays of KEYS from a file; sparse ones become dense."""
    if not path.is_file():
        raise InputError(f"{path}: no such body model; give the path of an SMPL, SMPL-H or SMPL-X file, or anny")
    if path.suffix == ".pkl":
        stored = read_pickle(path)
        found = {key: stored[key] for key in KEYS if key in stored} if isinstance(stored, dict) else {}
    else:
        try:
            found = read_arrays(path, KEYS, MAX_BYTES)
        except ARRAY_FILE_ERRORS as error:
            raise_if_unreachable(error)
            raise InputError(f"{path}: is not a .npz of plain arrays; convert the model again") from None
    missing = [key for key in KEYS if key not in found]
    if missing:
        raise InputError(f"{path}: no {', '.join(missing)}; give an SMPL, SMPL-H or SMPL-X model")
    return {key: value.toarray() if scipy.sparse.issparse(value) else value for key, value in found.items()}


def _checked(path: Path, data: dict[str, Any]) -> dict[str, Tensor]:
    """Return the arrays as float64 tensors. Raises InputError unless all shapes are those of a known model and all
    numbers finite."""
    try:
        arrays = {key: torch.from_numpy(np.array(data[key], dtype=np.float64)) for key in KEYS}
    except (OverflowError, TypeError, ValueError):
        raise InputError(f"{path}: holds other data than arrays of numbers; convert the model again") from None
    vertices, joints = (arrays[key].shape[0] if arrays[key].ndim else 0 for key in ("v_template", "J_regressor"))
    if vertices not in MESHES or joints not in FURTHER_JOINTS:
        raise InputError(f"{path}: {vertices} vertices and {joints} joints are not those of SMPL, SMPL-H or SMPL-X")
    shapes: dict[str, tuple[int, ...]] = {
        "v_template": (vertices, 3),
        "posedirs": (vertices, 3, 9 * (joints - 1)),
        "J_regressor": (joints, vertices),
        "weights": (vertices, joints),
        "kintree_table": (2, joints),
    }
    wrong = [key for key, shape in shapes.items() if arrays[key].shape != shape]
    *ends, betas = arrays["shapedirs"].shape or (0,)
    wrong += [] if ends == [vertices, 3] and betas >= BETAS else ["shapedirs"]
    wrong += [] if len(arrays["f"].shape) == 2 and arrays["f"].shape[1] == 3 and len(arrays["f"]) else ["f"]
    if wrong := wrong or _wrong_numbers(arrays):
        raise InputError(f"{path}: {wrong[0]} is not that of an SMPL model; convert it again")
    return arrays


def _wrong_numbers(arrays: dict[str, Tensor]) -> list[str]:
    """Return which arrays, though their shapes are right, hold NaN, parents below their children or vertices that do
    not exist."""
    wrong = [key for key in KEYS if not arrays[key].isfinite().all()]
    above, faces = arrays["kintree_table"][0, 1:], arrays["f"]
    wrong += [] if ((above >= 0) & (above < torch.arange(1, len(above) + 1))).all() else ["kintree_table"]
    return wrong + ([] if faces.min() >= 0 and faces.max() < len(arrays["v_template"]) else ["f"])


def _bones(names: tuple[str, ...], joints_m: Tensor) -> dict[str, Tensor]:
    """Return the direction of each limb's bone."""
    ends = {f"{bone}.{side}": f"{end}.{side}" for bone, end in BONE_ENDS.items() for side in "LR"}
    return {bone: joints_m[names.index(end)] - joints_m[names.index(bone)] for bone, end in ends.items()}


def _pose_blend_shape(posedirs: Tensor, rotations: Tensor, parents: list[int]) -> Tensor:
    """Return the displacement (V, 3), body frame, that the model's pose blend shapes give the rest pose (Loper et al.
    2015, eq. 9)."""
    local = rotations[parents[1:]].mT @ rotations[1:]
    feature = BODY_FROM_SMPL.T @ local @ BODY_FROM_SMPL - torch.eye(3, dtype=local.dtype)
    return (posedirs @ feature.flatten()) @ BODY_FROM_SMPL.T


def _reposed(
    vertices_m: Tensor, joints_m: Tensor, weights: Tensor, rotations: Tensor, parents: list[int]
) -> tuple[Tensor, Tensor]:
    """Return template and shapes (S, V, 3) and their joints (S, J, 3) skinned into the rest pose, which is linear in
    both."""
    placed = [joints_m[:, 0]]
    for j, parent in enumerate(parents[1:], 1):
        placed.append(placed[parent] + (joints_m[:, j] - joints_m[:, parent]) @ rotations[parent].T)
    rest_m = torch.stack(placed, 1)
    shift = rest_m - (rotations @ joints_m[..., None])[..., 0]
    blended = (weights @ rotations.flatten(1)).unflatten(1, (3, 3))
    return (blended @ vertices_m[..., None])[..., 0] + weights @ shift, rest_m


def _keypoint_weights(names: tuple[str, ...], regressor: Tensor, mesh: int) -> Tensor:
    """Return BODY_25 regression weights (25, V)."""
    rows = torch.zeros(25, regressor.shape[1], dtype=regressor.dtype)
    for row, source in zip(rows, BODY_25, strict=True):
        if isinstance(source[0], int):
            row[source[mesh]] = 1
        else:
            row += torch.stack([regressor[names.index(str(name))] for name in source]).mean(0)
    return rows / rows.sum(1, keepdim=True)


def _moved_off(weights: Tensor, vertices_m: Tensor, kept: Tensor) -> Tensor:
    """Return weights (25, kept V) in which each dropped vertex gives its weight to the nearest one that is kept."""
    for v in ((weights != 0).any(0) & ~kept).nonzero()[:, 0].tolist():
        distance = (vertices_m - vertices_m[v]).norm(dim=1).where(kept, torch.inf)
        weights[:, distance.argmin()] += weights[:, v]
    return weights[:, kept]

"""Motions in BVH files, on the joints of anny's average body."""

import re
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hnerf.body.body_model import body_model
from hnerf.body.bvh import Bvh, read_bvh
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import Rig
from hnerf.body.skeletons import EQUIVALENTS, FINGERS, PELVIS, SKELETONS, exported_from, exported_name, is_serial
from hnerf.config import FitSettings
from hnerf.errors import InputError
from hnerf.geometry.axes import Y_UP_FROM_Z_UP

LIMBS = ("thigh", "calf", "foot", "upperarm", "forearm", "hand")
NEEDED = (PELVIS, *(f"{limb}_{side}" for side in "LR" for limb in LIMBS))
ENDS = {"upperarm": "forearm", "forearm": "hand", "thigh": "calf", "calf": "foot"}  # of limbs whose rest poses differ
AT_REST = {name for name in EQUIVALENTS if is_serial(name) or name.startswith(FINGERS)}  # at rest whatever files say
PREFIX = re.compile(r".*:|mixamorig\d*_?")


def bvh_motion(path: Path) -> tuple[BodyFit, float]:
    """Read a BVH file as poses of anny's average body in a world with Y up; return them and their frame rate.

    Joints are found by their names in one of the skeletons of hnerf/body/skeletons.py. Raises InputError if joints are
    missing, or `read_bvh` does.
    """
    file = read_bvh(path)
    rig = body_model(FitSettings()).rig(None).to(dtype=torch.float32)
    return retargeted(path, file, rig), round(1 / file.frame_s, 3)  # files give frame times to few digits


def retargeted(path: Path, file: Bvh, rig: Rig) -> BodyFit:
    """Return a file's poses on a rig. Lengths are scaled by the ratio of leg lengths.

    The rig's limbs are first turned, by the shortest rotation, to point as the file's do at rest; from there, each
    joint turns in the world as the file's does. Joints that the file lacks, and those that are not free, stay at rest.
    """
    joints = joints_by_name(path, file.names)
    upright = _upright(path, file, joints)
    turns, at = file.world()
    turns, at = upright @ turns @ upright.T, at @ upright.T
    rest, places = file.rest() @ upright.T, rig.joints_m.double().numpy() @ Y_UP_FROM_Z_UP.T
    own = {exported_name(name): j for j, name in enumerate(rig.joint_names)}
    free = [name for name, j in own.items() if name in joints and (name == PELVIS or rig.free[j])]
    world = {name: turns[:, joints[name]] @ _to_rest_of_file(name, joints, rest, own, places) for name in free}

    theta = np.zeros((len(turns), len(rig.joint_names), 3))
    for name in free:
        if name == PELVIS:
            continue
        local = world[_above(rig, own[name], world)].swapaxes(1, 2) @ world[name]
        body = Y_UP_FROM_Z_UP.T @ local @ Y_UP_FROM_Z_UP
        theta[:, own[name]] = Rotation.from_matrix(body).as_rotvec()

    root = np.tile(np.eye(4), (len(turns), 1, 1))
    root[:, :3, :3] = world[PELVIS] @ Y_UP_FROM_Z_UP
    hips = at[:, [joints["thigh_L"], joints["thigh_R"]]].mean(1)
    hips_m = places[[own["thigh_L"], own["thigh_R"]]].mean(0)
    scale = _leg(places, own) / _leg(rest, joints)
    root[:, :3, 3] = scale * hips - world[PELVIS] @ hips_m
    frames = tuple(range(len(turns)))
    return BodyFit(rig, frames, torch.from_numpy(theta).float(), torch.from_numpy(root).float())


def joints_by_name(path: Path, names: tuple[str, ...]) -> dict[str, int]:
    """Return the index of a file's joint for each exported name, by the skeleton that shares most names with the file.
    Joints that stay at rest do not count: CMU's fingers are named like HumanIK's, its trunk is not. Raises InputError
    if hips, arms or legs are missing."""
    plain = {PREFIX.sub("", name).lower(): j for j, name in reversed(list(enumerate(names)))}
    tables = [{name: name for name in EQUIVALENTS}, *map(exported_from, SKELETONS)]
    found = [{ours: plain[t.lower()] for t, ours in table.items() if t.lower() in plain} for table in tables]
    best = max(found, key=lambda joints: (sum(name in joints for name in NEEDED), len(joints.keys() - AT_REST)))
    missing = [name for name in NEEDED if name not in best]
    if missing:
        raise InputError(
            f"{path}: no joint for {', '.join(missing[:3])}; name them as one of {', '.join(SKELETONS)} does "
            "(docs/asset.md has a table)"
        )
    return best


def _upright(path: Path, file: Bvh, joints: dict[str, int]) -> np.ndarray:
    """Return the rotation (3, 3) from the file's axes to Y up with the rest pose facing +Z. Raises InputError if the
    rest pose does not stand along Y or Z, or a limb has no direction."""
    rest = file.rest()
    for start, end in ((f"{start}_{side}", f"{end}_{side}") for start, end in ENDS.items() for side in "LR"):
        if np.array_equal(rest[joints[start]], rest[joints[end]]):
            raise InputError(f"{path}: {start} and {end} coincide at rest; export it in a T pose")
    legs = (rest[[joints["thigh_L"], joints["thigh_R"]]] - rest[[joints["foot_L"], joints["foot_R"]]]).mean(0)
    axis = int(np.abs(legs).argmax())
    if axis == 0 or legs[axis] <= 0:
        raise InputError(f"{path}: the rest pose does not stand upright along Y or Z; export it in a T pose")
    stands = np.eye(3) if axis == 1 else Y_UP_FROM_Z_UP
    across = stands @ (rest[joints["thigh_L"]] - rest[joints["thigh_R"]])
    across[1] = 0
    if not np.linalg.norm(across) > 1e-6 * np.linalg.norm(legs):
        raise InputError(f"{path}: left and right hip coincide at rest; export it in a T pose")
    left = across / np.linalg.norm(across)
    return np.stack([left, [0.0, 1, 0], np.cross(left, [0.0, 1, 0])]) @ stands


def _to_rest_of_file(
    name: str, joints: dict[str, int], rest: np.ndarray, own: dict[str, int], places: np.ndarray
) -> np.ndarray:
    """Return the rotation (3, 3) that turns a limb of the rig at rest to where the file's points at rest; a hand takes
    its forearm's."""
    limb, _, side = name.partition("_")
    limb = "forearm" if limb == "hand" else limb
    if limb not in ENDS or side not in ("L", "R"):
        return np.eye(3)
    start, end = f"{limb}_{side}", f"{ENDS[limb]}_{side}"
    theirs, ours = rest[joints[end]] - rest[joints[start]], places[own[end]] - places[own[start]]
    return np.asarray(Rotation.align_vectors(theirs[None], ours[None])[0].as_matrix())


def _above(rig: Rig, joint: int, known: dict[str, np.ndarray]) -> str:
    """Return the exported name of the nearest joint above that is known; the pelvis always is."""
    while True:
        joint = int(rig.parents[joint])
        name = exported_name(rig.joint_names[joint])
        if name in known:
            return name


def _leg(at: np.ndarray, joints: dict[str, int]) -> float:
    """Return the mean length of the legs from hip to ankle, in the unit of positions (J, 3)."""
    chain = [[at[joints[f"{limb}_{side}"]] for limb in ("thigh", "calf", "foot")] for side in "LR"]
    return float(np.mean([np.linalg.norm(np.diff(leg, axis=0), axis=1).sum() for leg in chain]))

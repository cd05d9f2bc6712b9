"""Poses to render an avatar in: motions of other subjects, BVH or AMASS files, and interpolation between two poses."""

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from hnerf.avatar.finished import readable
from hnerf.body.body_model import body_model
from hnerf.body.fit_result import BodyFit
from hnerf.body.given_start import initial_pose_from_given
from hnerf.body.rig import Rig, joint_transforms, pose_vertices
from hnerf.body.t_pose import t_pose
from hnerf.capture.capture import Capture
from hnerf.capture.footage import MAX_FPS, MIN_FPS
from hnerf.capture.given_poses import JOINTS, GivenPoses, check_smpl
from hnerf.capture.safe_io import ARRAY_FILE_ERRORS, read_arrays
from hnerf.config import FitSettings
from hnerf.errors import InputError, raise_if_unreachable
from hnerf.geometry.axes import y_up_from
from hnerf.geometry.rotations import slerp
from hnerf.progress import tracked
from hnerf.render.bvh_motion import bvh_motion

AMASS_WIDTHS = (72, 156, 165)  # pose parameters of SMPL, SMPL-H and SMPL-X, which share their first 22 joints
AMASS_RATES = ("mocap_framerate", "mocap_frame_rate")
BODY_JOINTS = 22
HIPS = ("upperleg01.L", "upperleg01.R")
LEG = "upperleg01.L", "foot.L"
DEFAULT_FPS = 30.0  # of AMASS files without a rate
T_POSE = Path("t-pose")  # stands for that pose in place of a motion's file
BELOW_FLOOR = 0.05  # share of a motion's frames with a foot below its floor, due to errors
MAX_MOTION_BYTES = 256_000_000  # unpacked; half an hour of SMPL-H at 100 poses a second


@dataclass(frozen=True)
class Motion:
    """A motion to show. body: its poses, on the rig that they were made for; fps: frames per second; up: the vertical
    axis of its world, "y" or "z"."""

    body: BodyFit
    fps: float
    up: str


def t_pose_motion(rig: Rig) -> Motion:
    """Return the T pose of a rig as a motion of one frame."""
    return Motion(BodyFit(rig, (0,), t_pose(rig)[None], torch.eye(4)[None]), DEFAULT_FPS, "z")


def read_motion(path: Path, frames: str = ":") -> Motion:
    """Read a motion: frames (see `select_frames`) of another subject's folder, which holds a capture and a training or
    fit, of a .bvh file (`bvh_motion`), or of an AMASS .npz file.

    AMASS poses are SMPL's; they are converted to the joints of anny's average body, with fingers and toes at rest.
    Raises InputError if there is no motion or it lacks these frames.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file; give a .bvh, an AMASS .npz, <store>/subjects/<name> or t-pose")
    if path.is_dir():
        return _subject_motion(path, frames)
    if path.suffix.lower() == ".bvh":
        body, fps = bvh_motion(path)
        return Motion(select_poses(body, select_frames(body.frames, frames, path)), fps, "y")
    given, fps = _read_amass(path)
    chosen = list(select_frames(tuple(range(len(given.theta))), frames, path))
    given = dataclasses.replace(given, theta=given.theta[chosen], root=given.root[chosen])
    pose = initial_pose_from_given(given, body_model(FitSettings()), chosen)
    rig = pose.rig.to(dtype=torch.float32)
    return Motion(BodyFit(rig, tuple(chosen), pose.theta.float(), pose.root.float()), fps, "z")


def select_frames(frames: tuple[int, ...], wanted: str, source: Path) -> tuple[int, ...]:
    """Return those of `frames` that `wanted` selects: one number like "12", or "FIRST:END:STEP" as in a Python slice,
    END excluded.

    Raises InputError, naming `source`, if the selection is malformed or empty.
    """
    if not re.fullmatch(r"\d{1,9}|\d{0,9}:\d{0,9}(:[1-9]\d{0,8})?", wanted):
        raise InputError(f"--frames {wanted[:80]}: give a number like 12, or FIRST:END:STEP like 0:24:2")
    parts = [int(part) if part else None for part in wanted.split(":")]
    numbers = range(*slice(*parts).indices(max(frames) + 1)) if ":" in wanted else range(int(wanted), int(wanted) + 1)
    chosen = tuple(frame for frame in frames if frame in numbers)
    if not chosen:
        raise InputError(f"{source}: no frames {wanted}; it has {min(frames)} to {max(frames)}")
    return chosen


def select_poses(body: BodyFit, frames: tuple[int, ...]) -> BodyFit:
    """Return the body with the poses of these frames only."""
    rows = {frame: row for row, frame in enumerate(body.frames)}  # `body.index` would search all frames for each
    chosen = [rows[frame] for frame in frames]
    return dataclasses.replace(body, frames=frames, theta=body.theta[chosen], root=body.root[chosen])


def retarget(own: BodyFit, motion: Motion, up: str, source: object = "motion") -> BodyFit:
    """Return the motion's poses on the rig of `own`, with the rotations of joints matched by name.

    The middle of the hips follows its path on the motion's own body, so that standing legs keep standing while the
    trunk bends, scaled by the length of the legs, so that a standing foot does not slide while the hips pass over it.
    The path is shifted so that its mean position coincides with that of `own`. The motion's floor, which 5 % of its
    frames reach below, is put on that of `own`: the median of its lowest points, on which the asset stands. In each
    frame the lowest point keeps the height above the floor that it had on the motion's own body.
    `up`: the vertical axis of the world of `own`. Raises InputError, naming `source`, if the motion lacks a joint.
    """
    other, names = motion.body, motion.body.rig.joint_names
    theta = torch.zeros(len(other.frames), len(own.rig.joint_names), 3)
    for j, name in enumerate(own.rig.joint_names):
        if name in names:  # this includes fingers, which are not free, but fitted
            theta[:, j] = other.theta[:, names.index(name)]
        elif own.rig.free[j]:
            raise InputError(f"{source}: has no joint {name}; use a motion that was fitted with this body model")
    turn = torch.eye(4)
    turn[:3, :3] = torch.from_numpy(y_up_from(up).T @ y_up_from(motion.up))
    placed = BodyFit(own.rig, other.frames, theta, turn @ other.root)
    hips_m = _leg_m(own.rig) / _leg_m(other.rig) * (middle_of_hips_m(other) @ turn[:3, :3].T)
    placed = set_middle_of_hips(placed, hips_m + middle_of_hips_m(own).mean(0) - hips_m.mean(0))
    lowest_m = lowest_points_m(other, motion.up)
    above_floor_m = lowest_m - lowest_m.quantile(BELOW_FLOOR)  # the motion may be in the air half of the time
    return set_lowest_points(placed, above_floor_m + lowest_points_m(own, up).quantile(0.5), up)


def interpolate_poses(body: BodyFit, first: int, last: int, count: int) -> BodyFit:
    """Return `count` poses from frame `first` to frame `last` of the body, both included, numbered from 0.

    Joint and root rotations are interpolated at constant angular velocity, the root's position linearly.
    """
    a, b = body.index(first), body.index(last)
    share = np.linspace(0, 1, count)
    start, end = (Rotation.from_rotvec(body.theta[k].numpy()) for k in (a, b))
    theta = np.stack([slerp(start, end, np.full(len(start), t)).as_rotvec() for t in share])
    root = torch.lerp(body.root[a], body.root[b], torch.from_numpy(share).to(body.root)[:, None, None])
    start, end = (Rotation.from_matrix(body.root[[k] * count, :3, :3].numpy()) for k in (a, b))
    root[:, :3, :3] = torch.from_numpy(slerp(start, end, share).as_matrix())
    return BodyFit(body.rig, tuple(range(count)), torch.from_numpy(theta).to(body.theta), root)


def middle_of_hips_m(body: BodyFit) -> Tensor:
    """Return the middle of the hip joints, (n, 3), in the world; the root joint of a rig without legs."""
    hips = [j for j, name in enumerate(body.rig.joint_names) if name in HIPS] or [0]
    return joint_transforms(body.rig, body.theta, body.root)[:, hips, :3, 3].mean(1)


def _leg_m(rig: Rig) -> float:
    """Return the distance from hip to ankle at rest; 1 for a rig without legs."""
    if not set(LEG) <= set(rig.joint_names):
        return 1.0
    hip_m, ankle_m = (rig.joints_m[rig.joint_names.index(name)] for name in LEG)
    return float(torch.dist(hip_m, ankle_m))


def set_middle_of_hips(body: BodyFit, points_m: Tensor) -> BodyFit:
    """Return the same poses, translated so that the middle of the hip joints is at `points_m` (n, 3).

    Its place in the body frame differs between rigs: if that frame's origin were matched instead, hips and standing
    feet would slide while the trunk bends.
    """
    return _translated(body, points_m - middle_of_hips_m(body))


def lowest_points_m(body: BodyFit, up: str) -> Tensor:
    """Return the height (n,) of each pose's lowest vertex along the world's axis `up`."""
    # One at a time: all vertices at once would fill the memory.
    poses = tracked(zip(body.theta, body.root, strict=True), "lowest points", len(body.frames))
    return torch.stack([pose_vertices(body.rig, *pose)[:, "xyz".index(up)].min() for pose in poses])


def set_lowest_points(body: BodyFit, heights_m: Tensor, up: str) -> BodyFit:
    """Return the same poses, translated along the axis `up` so that their lowest vertices are at `heights_m` (n,)."""
    move_m = (heights_m - lowest_points_m(body, up))[:, None] * torch.eye(3)["xyz".index(up)]
    return _translated(body, move_m)


def _translated(body: BodyFit, move_m: Tensor) -> BodyFit:
    root = body.root.clone()
    root[:, :3, 3] += move_m
    return dataclasses.replace(body, root=root)


def _subject_motion(folder: Path, frames: str) -> Motion:
    found = [folder / stage for stage in ("training", "fit") if (folder / stage / "body.npz").is_file()]
    if not found or not (folder / "capture" / "capture.json").is_file():
        raise InputError(f"{folder}: holds no fitted body; give <store>/subjects/<name>, a .bvh or an AMASS .npz")
    with readable(found[0]):
        body = BodyFit.load(found[0])
    with readable(folder / "capture" / "capture.json"):
        capture = Capture.load(folder / "capture")
    return Motion(select_poses(body, select_frames(body.frames, frames, folder)), capture.fps, capture.up)


def _read_amass(path: Path) -> tuple[GivenPoses, float]:
    """Read the SMPL parameters of an AMASS file (Mahmood et al. 2019), whose Z axis is up, and its frames per
    second."""
    keys = ("poses", "trans", *AMASS_RATES)
    try:
        found = {key: array.astype(np.float64) for key, array in read_arrays(path, keys, MAX_MOTION_BYTES).items()}
    except ARRAY_FILE_ERRORS as error:
        raise_if_unreachable(error)
        raise InputError(f"{path}: not an .npz of plain arrays; give an AMASS file or a subject's folder") from None
    poses, trans = found.get("poses", np.zeros(0)), found.get("trans", np.zeros(0))
    known = poses.ndim == 2 and poses.shape[1] in AMASS_WIDTHS and trans.shape == (len(poses), 3) and len(poses) > 0
    if not known:
        raise InputError(f"{path}: poses {poses.shape}, trans {trans.shape} are not AMASS's (n, 156) and (n, 3)")
    check_smpl(path, poses, trans, np.zeros(0))
    given = dataclasses.replace(GivenPoses.unknown(len(poses)), theta=np.zeros((len(poses), JOINTS, 3)))
    given.theta[:, :BODY_JOINTS] = poses[:, : 3 * BODY_JOINTS].reshape(-1, BODY_JOINTS, 3)
    given.root[:] = np.eye(4)
    given.root[:, :3, 3] = trans
    rate = next((found[key] for key in AMASS_RATES if key in found), np.array(DEFAULT_FPS))
    if rate.size != 1 or not MIN_FPS <= rate.item() <= MAX_FPS:
        raise InputError(f"{path}: {rate.tolist()} frames per second; correct {AMASS_RATES[0]}")
    return given, rate.item()

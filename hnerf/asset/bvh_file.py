"""The captured motion as a BVH file, and the paths of its joints as a TRC file. Unless the asset names its joints after
another skeleton, they have their Mixamo names, without the prefix, where Mixamo has an equivalent."""

from pathlib import Path

import numpy as np

from hnerf.asset.motions import LONGEST_S, Motion, is_dense, resampled
from hnerf.asset.rigs import StagedRig
from hnerf.asset.skeleton import FRONT
from hnerf.asset.skinning import Skin
from hnerf.asset.staging import CAPTURED, stage_body
from hnerf.body.bvh import Bvh, write_bvh
from hnerf.body.fit_result import BodyFit
from hnerf.body.skeletons import OWN, JointNames, name_in
from hnerf.capture.capture import Capture
from hnerf.errors import InputError

CENTIMETRES = 100  # per metre; MotionBuilder and Maya read BVH files in centimetres
SURROUNDED = 0.2  # points whose mean is nearer to their joint than this share of the farthest one's distance


def require_dense(capture: Capture) -> None:
    """Raise InputError if the poses of a capture's frames will be too far apart to be interpolated."""
    if not is_dense(np.array(capture.frames) / capture.fps):
        raise InputError(
            f"{capture.name}: frames are more than {LONGEST_S} s apart on average; "
            "give --set capture.max_frames=100000, or list more frames if capture.toml lists any"
        )


def write_body_motion(out: Path, capture: Capture, body: BodyFit, joint_names: JointNames) -> None:
    """Write the motion of a fitted body into the folder `out`: `motion.bvh` and `motion.trc`."""
    rig, rest_points_m = stage_body(body, capture.up, capture.fps)
    write_captured_bvh(out / "motion.bvh", rig, rest_points_m, joint_names)
    write_captured_trc(out / "motion.trc", rig, joint_names)


def write_captured_bvh(path: Path, rig: StagedRig, rest_points_m: np.ndarray, joint_names: JointNames) -> None:
    """Write the captured motion of a rig. rest_points_m (V, 3): the surface that follows it, at rest."""
    ends = CENTIMETRES * tips_m(rig.skeleton.positions_m, rig.skin, rest_points_m)[1:]
    write_bvh(path, captured_bvh(rig, joint_names), ends)


def write_captured_trc(path: Path, rig: StagedRig, joint_names: JointNames) -> None:
    """Write the paths of the joints of the BVH file, in metres, with the frame numbers and times of the capture."""
    motion = captured_bvh(rig, joint_names)
    at_m, fps = motion.world()[1] / CENTIMETRES, 1 / motion.frame_s
    count, joints, first = len(at_m), len(motion.names), int(rig.motions[CAPTURED].codes[0])
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{fps:.9g}\t{fps:.9g}\t{count}\t{joints}\tm\t{fps:.9g}\t{first}\t{count}",
        "Frame#\tTime" + "".join(f"\t{name}\t\t" for name in motion.names),
        "\t" + "".join(f"\tX{k}\tY{k}\tZ{k}" for k in range(1, joints + 1)),
        "",
    ]
    for frame, row in enumerate(at_m.reshape(count, -1), first):
        lines.append("\t".join([str(frame), *(f"{value:.6f}" for value in (frame / fps, *row))]))
    path.write_text("\n".join(lines) + "\n")


def captured_bvh(rig: StagedRig, joint_names: JointNames) -> Bvh:
    """Return the captured motion of a rig's skeleton, from the pelvis down, in every frame of the capture from the
    first pose to the last, in centimetres, Y up."""
    skeleton, poses, stage = rig.skeleton, rig.motions[CAPTURED], rig.stage(CAPTURED)[:, 1:]
    # Relative to rest, where BVH's joints have no rotation.
    turned = stage[..., :3, :3] @ skeleton.rotations[1:].swapaxes(1, 2)
    parents = skeleton.parents[1:] - 1
    local, offsets = turned.copy(), CENTIMETRES * skeleton.positions_m[1:]
    local[:, 1:] = turned[:, parents[1:]].swapaxes(2, 3) @ turned[:, 1:]
    offsets[1:] -= CENTIMETRES * skeleton.positions_m[1:][parents[1:]]
    offsets[0] = 0  # some programs add the root's offset to its position channels, others ignore it
    captured = Motion(poses.fps, poses.codes, local, stage[:, 0, :3, 3], poses.shape_weights)
    motion = resampled(captured, poses.fps)
    positions = np.tile(offsets, (len(motion.codes), 1, 1))
    positions[:, 0] = CENTIMETRES * motion.origins_m
    own = joint_names == OWN
    named_as = "mixamo" if own else joint_names
    names = tuple(name_in(named_as, name, prefixed=not own) for name in skeleton.names[1:])
    return Bvh(names, parents, offsets, 1 / motion.fps, positions, motion.turns)


def tips_m(joints_m: np.ndarray, skin: Skin, points_m: np.ndarray) -> np.ndarray:
    """Return the tips of joints (J, 3), relative to them: towards the mean of the points (V, 3) that follow a joint
    most, or to the front if they surround it, as an eyeball's do, and as far as these points reach. Joints that no
    point follows most have none, (0, 0, 0)."""
    follows, tips = skin.joints[:, 0], np.zeros_like(joints_m)
    for joint in np.unique(follows):
        off_m = points_m[follows == joint] - joints_m[joint]
        mean_m, farthest_m = off_m.mean(0), np.linalg.norm(off_m, axis=1).max()
        surrounded = np.linalg.norm(mean_m) < SURROUNDED * farthest_m
        direction = FRONT if surrounded else mean_m / np.linalg.norm(mean_m)
        tips[joint] = (off_m @ direction).max() * direction
    return tips

"""BVH files (Biovision hierarchy): a skeleton whose joints are unrotated at rest, and its poses at a constant frame
rate."""

import io
import re
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hnerf.capture.safe_io import read_text
from hnerf.errors import InputError

MAX_BYTES = 128_000_000
MAX_JOINTS = 1000
MAX_HEAD_LINES = 20 * MAX_JOINTS  # of the hierarchy; a joint takes 4 to 8
MAX_NUMBERS = 20_000_000  # in all frames together
MAX_VALUE = 1e6  # of an offset or a channel
FRAME_S = (1e-4, 10.0)  # shortest and longest duration of a frame
CHANNELS = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ")
# Rotation orders: while the middle angle is near 90 degrees, small turns change the outer two a lot. Roots turn about Y
# without limit, limbs bend about X and rise about Z.
ROOT_ORDER, JOINT_ORDER = "YZX", "XYZ"


@dataclass(frozen=True)
class Bvh:
    """A skeleton and its poses, lengths in the file's unit. names (J,), parents (J,) with -1 at the root, offsets (J,
    3) from the parent at rest; frame_s: seconds per frame; positions (n, J, 3) relative to the parent's axes, rotations
    (n, J, 3, 3) likewise."""

    names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    frame_s: float
    positions: np.ndarray
    rotations: np.ndarray

    def rest(self) -> np.ndarray:
        """Return the joints at rest, (J, 3)."""
        at = self.offsets.copy()
        for j, parent in enumerate(self.parents[1:], 1):
            at[j] += at[parent]
        return at

    def world(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the joints' rotations (n, J, 3, 3) and positions (n, J, 3) in the file's world."""
        turns, at = self.rotations.copy(), self.positions.copy()
        for j, parent in enumerate(self.parents[1:], 1):
            at[:, j] = at[:, parent] + (turns[:, parent] @ at[:, j, :, None])[..., 0]
            turns[:, j] = turns[:, parent] @ turns[:, j]
        return turns, at


@dataclass
class _Joint:
    name: str
    parent: int
    offset: list[float] | None = None
    channels: tuple[str, ...] = ()


def read_bvh(path: Path) -> Bvh:
    """Read a BVH file. Raises InputError, naming file and line, if it is not one or is too large."""
    lines = read_text(path, MAX_BYTES).split("\n", MAX_HEAD_LINES)
    joints, at = _hierarchy(path, lines)
    frames, frame_s, at = _motion_head(path, lines, at)
    width = sum(len(joint.channels) for joint in joints)
    if not width:
        raise InputError(f"{path}: no joint has channels; export it again")
    if frames * max(width, 3 * len(joints)) > MAX_NUMBERS:  # joints without channels take as much memory
        raise InputError(f"{path}: {frames} frames of {len(joints)} joints are too many; cut the motion")
    rows = [row[0] for row in islice(re.finditer(r"\S[^\n]*", "\n".join(lines[at:])), frames)]
    if len(rows) < frames:
        raise InputError(f"{path}: says {frames} frames and has {len(rows)}; export it again")
    try:
        values = np.loadtxt(io.StringIO("\n".join(rows)), ndmin=2, comments=None)
    except ValueError as error:
        raise InputError(f"{path}: frames are not numbers ({error}); export it again") from None
    if values.shape != (frames, width) or not (np.abs(values) <= MAX_VALUE).all():  # also true for NaN
        raise InputError(f"{path}: frames are not {width} numbers below {MAX_VALUE:g} each; export it again")
    return _poses(joints, values, frame_s)


def write_bvh(path: Path, motion: Bvh, ends: np.ndarray) -> None:
    """Write a motion. Only the root's positions are written; other joints keep their offsets. ends (J, 3): end sites of
    the joints that have none below them, relative to these."""
    lines = ["HIERARCHY", *_hierarchy_lines(motion, ends, 0, ""), "MOTION", f"Frames: {len(motion.positions)}"]
    lines.append(f"Frame Time: {motion.frame_s:.9g}")
    turns = [
        Rotation.from_matrix(motion.rotations[:, joint]).as_euler(_written_order(joint), degrees=True)
        for joint in _depth_first(motion.parents)
    ]
    angles = _without_jumps(np.stack(turns, 1)).reshape(len(motion.positions), -1)
    for row in np.concatenate([motion.positions[:, 0], angles], 1):
        lines.append(" ".join(f"{value:.6f}" for value in row))
    path.write_text("\n".join(lines) + "\n")


def _without_jumps(angles: np.ndarray) -> np.ndarray:
    """Return Euler angles (n, J, 3) in degrees of the same rotations, so that programs can interpolate between frames.
    (a, b, c) and (a + 180, 180 - b, c + 180) are one rotation: take the one that is nearer to the frame before."""
    found = angles.copy()
    for k in range(1, len(found)):
        both = np.stack([angles[k], angles[k] * (1, -1, 1) + 180])
        both += 360 * np.round((found[k - 1] - both) / 360)
        away = ((both - found[k - 1]) ** 2).sum(-1)
        found[k] = np.where((away[0] <= away[1])[:, None], *both)
    return found


def _hierarchy(path: Path, lines: list[str]) -> tuple[list[_Joint], int]:
    """Return the joints, parents first, and the index of the line after MOTION."""
    joints: list[_Joint] = []
    open_joints: list[int] = []  # -1 for an end site
    found = None

    def wrong(number: int, what: str) -> InputError:
        return InputError(f"{path}: line {number + 1}: {what}; export it again as BVH")

    for number, line in enumerate(lines[:MAX_HEAD_LINES]):
        words = line.split()
        match words:
            case [] | ["HIERARCHY"]:
                continue
            case ["ROOT" | "JOINT" as kind, *name] if name:
                parent = open_joints[-1] if open_joints else -1
                if (kind == "ROOT") != (not joints) or (joints and parent < 0):
                    raise wrong(number, f"{kind} in the wrong place; one skeleton with one root is read")
                if len(joints) == MAX_JOINTS:
                    raise wrong(number, f"more than {MAX_JOINTS} joints")
                joints.append(_Joint(" ".join(name), parent))
                found = len(joints) - 1
            case ["End", "Site"]:
                found = -1
            case ["{"] if found is not None:
                open_joints.append(found)
                found = None
            case ["}"] if open_joints:
                open_joints.pop()
            case ["OFFSET", *numbers] if open_joints:
                offset = _numbers(numbers)
                if offset is None:
                    raise wrong(number, "OFFSET is not three numbers")
                if open_joints[-1] >= 0:
                    joints[open_joints[-1]].offset = offset
            case ["CHANNELS", count, *names] if open_joints and open_joints[-1] >= 0:
                unknown = set(names) - set(CHANNELS) or len(set(names)) < len(names)
                if count != str(len(names)) or unknown:
                    raise wrong(number, "CHANNELS does not list what it counts")
                joints[open_joints[-1]].channels = tuple(names)
            case ["MOTION"] if joints and not open_joints and all(joint.offset for joint in joints):
                return joints, number + 1
            case _:
                raise wrong(number, f"{line.strip()[:40]!r} is not expected here")
    raise InputError(f"{path}: has no MOTION; export it again as BVH")


def _numbers(words: list[str]) -> list[float] | None:
    """Return three numbers of bounded size; None if the words are anything else."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        return None
    return values if len(values) == 3 and all(abs(value) <= MAX_VALUE for value in values) else None


def _motion_head(path: Path, lines: list[str], at: int) -> tuple[int, float, int]:
    """Return the number of frames, the seconds per frame, and the line where the frames begin."""
    words = " ".join(lines[at : at + 4]).split()
    try:
        _, frames, *_, frame_s = words[: words.index("Time:") + 2]
        count, seconds = int(frames), float(frame_s)
    except ValueError:
        raise InputError(
            f"{path}: line {at + 1}: no `Frames:` and `Frame Time:` below MOTION; export it again"
        ) from None
    if count < 1 or not FRAME_S[0] <= seconds <= FRAME_S[1]:
        raise InputError(f"{path}: {count} frames of {seconds:g} s; correct `Frames:` and `Frame Time:`")
    while "Time:" not in lines[at]:
        at += 1
    return count, seconds, at + 1


def _poses(joints: list[_Joint], values: np.ndarray, frame_s: float) -> Bvh:
    offsets = np.array([joint.offset for joint in joints])
    positions = np.tile(offsets, (len(values), 1, 1))
    rotations = np.tile(np.eye(3), (len(values), len(joints), 1, 1))
    column = 0
    for j, joint in enumerate(joints):
        own = dict(zip(joint.channels, values[:, column : column + len(joint.channels)].T, strict=True))
        column += len(joint.channels)
        for axis, letter in enumerate("XYZ"):
            positions[:, j, axis] = own.get(f"{letter}position", positions[:, j, axis])
        turning = [channel for channel in joint.channels if channel.endswith("rotation")]
        if turning:
            order = "".join(channel[0] for channel in turning)
            angles = np.stack([own[channel] for channel in turning], 1)
            rotations[:, j] = Rotation.from_euler(order, angles, degrees=True).as_matrix()
    parents = np.array([joint.parent for joint in joints])
    return Bvh(tuple(joint.name for joint in joints), parents, offsets, frame_s, positions, rotations)


def _written_order(joint: int) -> str:
    """Return the order of a joint's rotations in the file."""
    return JOINT_ORDER if joint else ROOT_ORDER


def _depth_first(parents: np.ndarray) -> list[int]:
    """Return the joints in the order in which the file lists them."""
    order, waiting = [], [0]
    while waiting:
        order.append(waiting.pop())
        waiting.extend(np.nonzero(parents == order[-1])[0][::-1].tolist())
    return order


def _hierarchy_lines(motion: Bvh, ends: np.ndarray, joint: int, indent: str) -> list[str]:
    """Return the lines of a joint and of all joints below it."""

    def offset(values: np.ndarray) -> str:
        return "OFFSET " + " ".join(f"{value:.6f}" for value in values)

    turning = " ".join(f"{axis}rotation" for axis in _written_order(joint))
    kind, channels = ("JOINT", f"3 {turning}") if joint else ("ROOT", f"6 Xposition Yposition Zposition {turning}")
    inside = f"{indent}\t"
    lines = [f"{indent}{kind} {motion.names[joint]}", f"{indent}{{", f"{inside}{offset(motion.offsets[joint])}"]
    lines.append(f"{inside}CHANNELS {channels}")
    below = np.nonzero(motion.parents == joint)[0].tolist()
    for child in below:
        lines += _hierarchy_lines(motion, ends, child, inside)
    if not below:
        lines += [f"{inside}End Site", f"{inside}{{", f"{inside}\t{offset(ends[joint])}", f"{inside}}}"]
    return [*lines, f"{indent}}}"]

"""The exported skeleton: the body model's joints, with readable names and orientations, below a root joint on the
ground.

All in the axes of asset formats (Y up, metres), at rest: the soles at height 0, the pelvis above the origin.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from hnerf.body.skeletons import ROOT, exported_name, is_serial

Bones = Literal["along", "identity"]

FRONT, UP = np.array([0.0, 0, 1]), np.array([0.0, 1, 0])  # of the rest body
SHORTEST_M = 1e-3  # joints closer together than this give no direction


@dataclass(frozen=True)
class Skeleton:
    """Joints at rest, parents before children. names (J,); parents (J,): -1 for the root; sources (J,): the body
    model's joint for each, -1 for the root on the ground; positions_m (J, 3); rotations (J, 3, 3): stage from joint."""

    names: tuple[str, ...]
    parents: np.ndarray
    sources: np.ndarray
    positions_m: np.ndarray
    rotations: np.ndarray

    @property
    def bind(self) -> np.ndarray:
        """Return the joints' transforms at rest, stage from joint, (J, 4, 4)."""
        transforms = np.tile(np.eye(4), (len(self.names), 1, 1))
        transforms[:, :3, :3], transforms[:, :3, 3] = self.rotations, self.positions_m
        return transforms

    def local(self, transforms: np.ndarray) -> np.ndarray:
        """Return transforms (..., J, 4, 4) of joints in the stage relative to their parents; the root's are kept."""
        found = transforms.copy()
        found[..., 1:, :, :] = np.linalg.inv(transforms[..., self.parents[1:], :, :]) @ transforms[..., 1:, :, :]
        return found

    def placed(self, translations_m: np.ndarray, quaternions: np.ndarray) -> np.ndarray:
        """Return the joints' transforms (n, J, 4, 4) in the stage. translations_m (n, J, 3), quaternions (n, J, 4) as
        x y z w: of their transforms relative to their parents, as `local` returns them."""
        found = np.tile(np.eye(4), (*quaternions.shape[:2], 1, 1))
        turns = Rotation.from_quat(quaternions.reshape(-1, 4)).as_matrix()
        found[..., :3, :3] = turns.reshape(*quaternions.shape[:2], 3, 3)
        found[..., :3, 3] = translations_m
        for j, parent in enumerate(self.parents[1:], 1):
            found[:, j] = found[:, parent] @ found[:, j]
        return found

    def posed(self, turned: np.ndarray, ground: np.ndarray) -> np.ndarray:
        """Return the joints' transforms (n, J, 4, 4) in the stage for poses of the body model.

        turned (n, S, 4, 4): the model's joints, whose orientations at rest are the identity; ground (n, 4, 4): the
        root.
        """
        transforms = np.concatenate([ground[:, None], turned], 1)[:, self.sources + 1]
        transforms[..., :3, :3] = transforms[..., :3, :3] @ self.rotations
        return transforms


def full_skeleton(joints: tuple[str, ...], parents: np.ndarray, positions_m: np.ndarray, bones: Bones) -> Skeleton:
    """Return the skeleton of a body model: joints (S,), parents (S,), at rest at positions_m (S, 3). Joints that the
    game skeleton has, too, have the axes that they have there."""
    names = (ROOT, *map(exported_name, joints))
    below = np.concatenate([[-1], parents + 1])
    at_m = np.concatenate([np.zeros((1, 3)), positions_m])
    full = Skeleton(names, below, np.arange(-1, len(joints)), at_m, _rotations(names, below, at_m, bones))
    game, _ = game_skeleton(full, bones)
    full.rotations[game.sources + 1] = game.rotations
    return full


def game_skeleton(full: Skeleton, bones: Bones) -> tuple[Skeleton, np.ndarray]:
    """Return the skeleton without serial joints, and, for each joint of the full one (J,), the joint of this one that
    takes its skin: itself, or the nearest one above it that is kept. All toes go to the middle one."""
    kept = [j for j, name in enumerate(full.names) if not is_serial(name)]
    place = {j: k for k, j in enumerate(kept)}
    taken_by = np.zeros(len(full.names), np.int64)
    for j, name in enumerate(full.names):
        toe = f"middle_toe_01_{name[-1]}"
        if j in place:
            taken_by[j] = place[j]
        elif "_toe_" in name and toe in full.names:
            taken_by[j] = place[full.names.index(toe)]
        else:
            taken_by[j] = taken_by[full.parents[j]]
    above = np.where(full.parents[kept] >= 0, taken_by[full.parents[kept]], -1)
    names, positions_m = tuple(full.names[j] for j in kept), full.positions_m[kept]
    rotations = _rotations(names, above, positions_m, bones)
    return Skeleton(names, above, full.sources[kept], positions_m, rotations), taken_by


def _rotations(names: tuple[str, ...], parents: np.ndarray, positions_m: np.ndarray, bones: Bones) -> np.ndarray:
    """Return joint orientations (J, 3, 3); the root's is always the identity."""
    rotations = np.tile(np.eye(3), (len(names), 1, 1))
    if bones == "along":
        rotations[1:] = along_bones(names, parents, positions_m)[1:]
    return rotations


def along_bones(names: tuple[str, ...], parents: np.ndarray, positions_m: np.ndarray) -> np.ndarray:
    """Return joint orientations (J, 3, 3) with Y along the bone, as in Blender, and Z as close to the front as that
    allows; for feet, toes and eyes, which point to the front themselves, Z is close to up."""
    directions = _directions(names, parents, positions_m)
    reference = np.array([UP if _points_to_front(name) else FRONT for name in names])
    z = reference - (reference * directions).sum(1, keepdims=True) * directions
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([np.cross(directions, z), directions, z], -1)


def _points_to_front(name: str) -> bool:
    return name.startswith(("foot", "eye", "toe")) or "_toe_" in name


def _directions(names: tuple[str, ...], parents: np.ndarray, positions_m: np.ndarray) -> np.ndarray:
    """Return the bones' directions (J, 3), each to the mean of the joints below it. For joints of the trunk, only those
    of the trunk count. The head points up, eyes point to the front, and other end joints continue the bone above.

    A joint that coincides with the one below it, as the pelvis does with the spine, has the direction of that one.
    """
    directions = np.zeros((len(names), 3))
    sided = np.array([name.endswith(("_L", "_R")) for name in names])
    for j in reversed(range(len(names))):
        below = [k for k in np.nonzero(parents == j)[0] if sided[j] or not sided[k]]
        off_m = (positions_m[below].mean(0) if below else positions_m[j]) - positions_m[j]
        if np.linalg.norm(off_m) > SHORTEST_M:
            directions[j] = off_m / np.linalg.norm(off_m)
        elif below:
            directions[j] = directions[below[0]]
    for j, name in enumerate(names):
        if name.startswith("eye"):
            directions[j] = FRONT
        elif name == "head":  # whatever is below it, such as a jaw
            directions[j] = UP
        elif not directions[j].any():
            directions[j] = UP if parents[j] < 0 else directions[parents[j]]
    return directions

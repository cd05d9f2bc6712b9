"""The captured motion as a BVH file, with the joints' names in Mixamo's skeleton where it has them."""

from pathlib import Path

import numpy as np

from hnerf.asset.rigs import GAME
from hnerf.asset.staging import CAPTURED, RATES, StagedAvatar
from hnerf.body.bvh import Bvh, write_bvh
from hnerf.body.skeletons import EQUIVALENTS

CENTIMETRES = 100  # a metre; what MotionBuilder and Maya take a BVH file's unit for
RATE = RATES[-1]


def write_avatar_bvh(path: Path, avatar: StagedAvatar) -> None:
    """Write the captured motion at 30 frames a second, on the game skeleton below its pelvis, in centimetres, Y up."""
    rig = avatar.rigs[GAME]
    skeleton, stage = rig.skeleton, rig.stage[f"{CAPTURED}_{RATE}"][:, 1:]
    # From rest, where BVH's joints are not turned.
    turned = stage[..., :3, :3] @ skeleton.rotations[1:].swapaxes(1, 2)
    parents = skeleton.parents[1:] - 1
    local, offsets = turned.copy(), CENTIMETRES * skeleton.positions_m[1:]
    local[:, 1:] = turned[:, parents[1:]].swapaxes(2, 3) @ turned[:, 1:]
    offsets[1:] -= CENTIMETRES * skeleton.positions_m[1:][parents[1:]]
    offsets[0] = 0  # some programs add the root's offset to its channels, others replace it by them
    positions = np.tile(offsets, (len(stage), 1, 1))
    positions[:, 0] = CENTIMETRES * stage[:, 0, :3, 3]
    names = tuple((name in EQUIVALENTS and EQUIVALENTS[name].mixamo) or name for name in skeleton.names[1:])
    write_bvh(path, Bvh(names, parents, offsets, 1 / RATE, positions, local))

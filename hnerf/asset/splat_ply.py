"""Splats as a PLY file, in the vertex layout of the published 3D Gaussian Splatting program, with a skin."""

from pathlib import Path

import numpy as np

from hnerf.asset.rigs import GAME
from hnerf.asset.splats import INFLUENCES, OPACITY, Splats
from hnerf.asset.staging import StagedAvatar

PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    *(f"joint_{k}" for k in range(INFLUENCES)),
    *(f"weight_{k}" for k in range(INFLUENCES)),
)


def write_splat_ply(path: Path, avatar: StagedAvatar, splats: Splats) -> None:
    """Write the splats at rest: the opacity as a logit, scales as logarithms, rotations as w x y z. Joints and weights
    are those of the game rig. All are float32, since some readers assume that of every property."""
    middles_m, normals, quaternions = splats.on(avatar.rest_points_m)
    skin = splats.skin(avatar.rigs[GAME])
    same = np.array([np.log(OPACITY / (1 - OPACITY)), *np.log(splats.scales_m)])
    columns = middles_m, normals, splats.coefficients, np.tile(same, (len(middles_m), 1)), quaternions
    values = np.concatenate([*columns, skin.joints, skin.weights], 1).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(values)}"]
    header += [*(f"property float {name}" for name in PROPERTIES), "end_header"]
    path.write_bytes("\n".join([*header, ""]).encode() + values.tobytes())

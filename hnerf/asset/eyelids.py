"""Eyelids without what lies before and above them in photographs, so that closed eyes look closed.

With open eyes, an upper lid is folded and seen obliquely: photographs give it lashes, iris and brow.
"""

from collections.abc import Mapping

import numpy as np

from hnerf.asset.field_colours import filled
from hnerf.asset.plate import cotangent_laplacian
from hnerf.asset.texture import Texels
from hnerf.body.rig import Rig

BLINKS = ("eyeBlinkLeft", "eyeBlinkRight")
BROWS = ("browInnerUp", "browOuterUpLeft", "browOuterUpRight", "browDownLeft", "browDownRight")
MOVED_M = 0.0005  # by which eyelids or brows move where skin is not plain
STRETCH = 1.2, 2.2  # of areas as the eyes close: from photographs alone to plain skin


def with_plain_lids(colours: np.ndarray, texels: Texels, rig: Rig, units_m: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return colours (N, 3) of texels in which skin that unfolds as the eyes close has the colour of the cheeks and the
    forehead. units_m: how expressions move the vertices (V, 3), by name. A face without those of lids and brows keeps
    its colours."""
    if not units_m.keys() >= {*BLINKS, *BROWS}:
        return colours
    faces, open_m = rig.faces.numpy(), rig.vertices_m.double().numpy()
    closed_m = open_m + sum(units_m[name] for name in BLINKS)
    areas_m2 = [cotangent_laplacian(vertices_m, faces)[0] for vertices_m in (open_m, closed_m)]
    unfolds = ((areas_m2[1] / areas_m2[0] - STRETCH[0]) / (STRETCH[1] - STRETCH[0])).clip(0, 1)
    moved = np.any([np.linalg.norm(units_m[name], axis=1) > MOVED_M for name in (*BLINKS, *BROWS)], 0)
    spoilt = moved[faces].any(1)[texels.face]
    plain = filled(np.where(spoilt[:, None], np.nan, colours), texels, rig)
    return colours + texels.interpolate(unfolds[:, None], faces) * (plain - colours)

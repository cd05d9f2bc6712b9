"""Defects of splats that OpenUSD's validators do not check."""

import numpy as np
from pxr import Usd, UsdVol

from hnerf.asset.rig_checks import samples

UNIT = 5e-3  # by which the length of a half-precision quaternion may differ from 1


def splat_defects(prim: Usd.Prim) -> list[str]:
    """Return one line for each defect of a prim of splats."""
    splats, name = UsdVol.ParticleField3DGaussianSplat(prim), prim.GetPath()
    scales, opacities = (np.array(a.Get() or []) for a in (splats.GetScalesAttr(), splats.GetOpacitiesAttr()))
    coefficients = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get() or [])
    degree, count, defects = splats.GetRadianceSphericalHarmonicsDegreeAttr().Get(), len(scales), []
    # Negated conditions, so that NaN fails.
    if not (count and (scales > 0).all() and np.isfinite(scales).all()):
        defects.append(f"{name}: scales are not finite or not above 0")
    if not (len(opacities) == count and ((opacities > 0) & (opacities <= 1)).all()):
        defects.append(f"{name}: opacities are not one a splat, above 0 and at most 1")
    if not (len(coefficients) == count * (degree + 1) ** 2 and np.isfinite(coefficients).all()):
        defects.append(f"{name}: coefficients are not finite or not those of degree {degree} for each splat")
    for time in samples(splats.GetPositionsAttr()):
        at_m, box_m = np.array(splats.GetPositionsAttr().Get(time)), np.array(splats.GetExtentAttr().Get(time))
        if not (len(at_m) == count and np.isfinite(at_m).all()):
            defects.append(f"{name}: positions are not finite or not one a splat at time {time}")
        elif not (box_m.shape == (2, 3) and (box_m[0] < at_m.min(0)).all() and (box_m[1] > at_m.max(0)).all()):
            defects.append(f"{name}: extent does not contain the positions at time {time}")
        turns = np.array(splats.GetOrientationshAttr().Get(time) or [], np.float32).reshape(-1, 4)
        if not (len(turns) == count and (np.abs(np.linalg.norm(turns, axis=1) - 1) < UNIT).all()):
            defects.append(f"{name}: orientations are not unit quaternions, one a splat, at time {time}")
    return defects

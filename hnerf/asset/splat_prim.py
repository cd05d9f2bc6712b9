"""The USD prim of an avatar's splats (UsdVol.ParticleField3DGaussianSplat)."""

import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdVol, Vt

from hnerf.asset.rigs import FULL
from hnerf.asset.splats import OPACITY, Splats
from hnerf.asset.staging import CAPTURED, StagedAvatar, box
from hnerf.asset.usd import ROOT, extent, vec3f

SIGMAS = 3  # from a splat's centre to the end of its box


def author_splats(stage: Usd.Stage, avatar: StagedAvatar, splats: Splats) -> None:
    """Define the splats. Since the schema cannot skin them, they have centres and orientations (half precision) at each
    frame of the captured motion, as the full rig moves the surface with its blend shapes."""
    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, ROOT.AppendChild("Splats"))
    count = len(splats.face)
    prim.CreateScalesAttr(vec3f(np.tile(splats.scales_m, (count, 1))))
    prim.CreateOpacitiesAttr(Vt.FloatArray(count, OPACITY))
    prim.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    prim.CreateRadianceSphericalHarmonicsCoefficientsAttr(vec3f(splats.coefficients))
    Usd.ColorSpaceAPI.Apply(prim.GetPrim()).CreateColorSpaceNameAttr(Gf.ColorSpaceNames.SRGBRec709)
    positions, orientations, boxes = prim.CreatePositionsAttr(), prim.CreateOrientationshAttr(), prim.CreateExtentAttr()
    everywhere = []
    surfaces_m = avatar.rigs[FULL].surfaces_m(CAPTURED, avatar.rest)
    for frame, surface_m in zip(avatar.frames.astype(float).tolist(), surfaces_m, strict=True):
        middles_m, _, quaternions = splats.on(surface_m)
        box_m = box(middles_m) + SIGMAS * splats.sigma_m * np.array([[-1], [1]])
        positions.Set(vec3f(middles_m), frame)
        # USD keeps the real part last.
        orientations.Set(Vt.QuathArray.FromNumpy(quaternions[:, [1, 2, 3, 0]].astype(np.float16)), frame)
        boxes.Set(vec3f(box_m), frame)
        everywhere.append(box_m)
    UsdGeom.ModelAPI(stage.GetDefaultPrim()).SetExtentsHint(extent(np.concatenate(everywhere)))

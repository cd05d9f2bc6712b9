"""Defects of an asset's structure, according to OpenUSD's guidelines for the root prim of a component."""

import numpy as np
from pxr import Kind, Usd, UsdGeom, UsdLux, UsdShade

INFORMATION = ("identifier", "name", "version", "captureDigest", "licence")


def package_defects(stage: Usd.Stage) -> list[str]:
    """Return one line for each defect of the stage's root prim and of its time codes."""
    root = stage.GetDefaultPrim()
    if not root:
        return ["has no default prim"]
    name, defects = root.GetPath(), []
    if Usd.ModelAPI(root).GetKind() != Kind.Tokens.component:
        defects.append(f"{name}: kind is {Usd.ModelAPI(root).GetKind() or 'missing'}, not component")
    missing = [key for key in INFORMATION if key not in root.GetAssetInfo()]
    if missing:
        defects.append(f"{name}: assetInfo has no {', '.join(missing)}")
    if not stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() > 0:
        defects.append("timeCodesPerSecond and framesPerSecond differ")
    if not stage.GetStartTimeCode() <= stage.GetEndTimeCode():
        defects.append("ends before it starts")
    return defects + _extent_defects(root) + _look_defects(root)


def _extent_defects(root: Usd.Prim) -> list[str]:
    """Return the defects of the root prim's extentsHint, the box that serves while payloads are not loaded."""
    hint = np.array(UsdGeom.ModelAPI(root).GetExtentsHintAttr().Get() or [])
    if hint.shape[:1] != (2,) or hint.shape[1:] != (3,) or not np.isfinite(hint).all():
        return [f"{root.GetPath()}: has no extentsHint"]
    for prim in Usd.PrimRange(root):
        if not prim.IsA(UsdGeom.Boundable):
            continue
        extent = UsdGeom.Boundable(prim).GetExtentAttr()
        for time in extent.GetTimeSamples():
            lower, upper = np.array(extent.Get(time))
            if (lower < hint[0] - 1e-4).any() or (upper > hint[1] + 1e-4).any():
                return [f"{root.GetPath()}: extentsHint does not contain {prim.GetPath()} at time {time}"]
    return []


def _look_defects(root: Usd.Prim) -> list[str]:
    """Return the defects of the meshes' materials, and of the light that an albedo needs to look as captured."""
    prims = list(Usd.PrimRange(root))
    meshes = [prim for prim in prims if prim.IsA(UsdGeom.Mesh)]
    bare = [mesh for mesh in meshes if not UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0]]
    defects = [f"{prim.GetPath()}: no material is bound" for prim in bare]
    if root.GetVariantSet("look").GetVariantSelection() == "albedo":
        domes = [UsdLux.DomeLight(prim) for prim in prims if prim.IsA(UsdLux.DomeLight)]
        if not any(dome.GetTextureFileAttr().Get() and dome.GetIntensityAttr().Get() > 0 for dome in domes):
            defects.append(f"{root.GetPath()}: the albedo has no light with a picture")
    return defects

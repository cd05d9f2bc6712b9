"""Validation of USD packages in all their variants, by OpenUSD's own validators and checks that they lack."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom, UsdShade, UsdSkel, UsdValidation, UsdVol

from hnerf.asset.materialx import is_unknown_node, node_defects
from hnerf.asset.package_checks import package_defects
from hnerf.asset.rig_checks import animation_defects, samples, skeleton_defects, skin_defects
from hnerf.asset.staging import box
from hnerf.errors import InvalidAsset

PLAUSIBLE_SIZE_M = (0.4, 3.0)  # longest side of the box around a person at rest; capture.toml takes 0.5 m to 2.5 m
UNIT = 5e-3  # by which the length of a half-precision quaternion may differ from 1


def validate_package(path: Path) -> dict[str, Any]:
    """Return the warnings and notes of OpenUSD's validators, over all variants. Raises InvalidAsset on their errors and
    on `data_defects`. That a build without MaterialX does not know a node of it is only a note."""
    stage = Usd.Stage.Open(str(path))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    findings: dict[str, dict[str, None]] = {"Error": {}, "Warn": {}, "Info": {}}
    variants = 0
    for selected in each_variant(stage):
        variants += 1
        for finding in UsdValidation.ValidationContext(validators).Validate(stage):
            if is_unknown_node(finding):
                findings["Info"][finding.GetMessage()] = None
            else:
                findings[finding.GetType().name][finding.GetErrorAsString()] = None
        findings["Error"] |= {f"{selected}{defect}": None for defect in data_defects(stage)}
    defects = list(findings["Error"])
    if defects:
        raise InvalidAsset(f"{path}: {'; '.join(defects)}")
    return {
        "validators": len(validators),
        "variants": variants,
        "warnings": list(findings["Warn"]),
        "infos": list(findings["Info"]),
    }


def each_variant(stage: Usd.Stage) -> Iterator[str]:
    """Select combinations of the root prim's variants in turn, in the session layer. Yield for each the start of a
    message about it, like "rig=full motion=captured: ", or nothing without variants. In each topology, these are all
    combinations that keep at least two of the motion, the shape and the level of detail that the file itself
    selects."""
    stage.SetEditTarget(stage.GetSessionLayer())
    root = stage.GetDefaultPrim()
    topologies = root.GetVariantSet("topology").GetVariantNames() if root else []
    for topology in topologies or [""]:
        stage.GetSessionLayer().Clear()
        if topology:
            root.GetVariantSet("topology").SetVariantSelection(topology)  # topologies differ in their other variants
        sets = {name: root.GetVariantSet(name) for name in root.GetVariantSets().GetNames()} if root else {}
        default = {name: v.GetVariantSelection() for name, v in sets.items()}
        names = {name: [topology] if name == "topology" else v.GetVariantNames() for name, v in sets.items()}
        for values in itertools.product(*names.values()):
            chosen = dict(zip(names, values, strict=True))
            further = {name for name, value in chosen.items() if value != default[name]}
            if len(further & {"lod", "motion", "shape"}) > 1:
                continue
            for name, value in chosen.items():
                sets[name].SetVariantSelection(value)
            words = " ".join(f"{name}={value}" for name, value in chosen.items())
            yield f"{words}: " if words else ""


def data_defects(stage: Usd.Stage) -> list[str]:
    """Return one line for each defect in units, structure, meshes, MaterialX nodes, skinning, skeletons and splats,
    for the selected variants."""
    defects = []
    if UsdGeom.GetStageMetersPerUnit(stage) != 1.0:
        defects.append(f"metersPerUnit is {UsdGeom.GetStageMetersPerUnit(stage)}, not 1")
    if UsdGeom.GetStageUpAxis(stage) != UsdGeom.Tokens.y:
        defects.append(f"up axis is {UsdGeom.GetStageUpAxis(stage)}, not Y")
    defects += package_defects(stage)
    found = 0
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            found += 1
            defects += _mesh_defects(UsdGeom.Mesh(prim))
            if prim.HasAPI(UsdSkel.BindingAPI):
                defects += skin_defects(prim)
        elif prim.IsA(UsdVol.ParticleField3DGaussianSplat):
            found += 1
            defects += _splat_defects(prim)
        elif prim.IsA(UsdShade.Shader):
            defects += node_defects(UsdShade.Shader(prim))
        elif prim.IsA(UsdSkel.Skeleton):
            defects += skeleton_defects(UsdSkel.Skeleton(prim))
        elif prim.IsA(UsdSkel.Animation):
            defects += animation_defects(UsdSkel.Animation(prim))
    return defects if found else [*defects, "has no mesh and no splats"]


def _mesh_defects(mesh: UsdGeom.Mesh) -> list[str]:
    name = mesh.GetPath()
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get())
    corners = int(np.sum(mesh.GetFaceVertexCountsAttr().Get()))
    defects = [] if corners == len(indices) else [f"{name}: {corners} face corners but {len(indices)} indices"]
    for time in samples(mesh.GetPointsAttr()):
        points = np.array(mesh.GetPointsAttr().Get(time))
        if not np.isfinite(points).all():
            defects.append(f"{name}: points are not finite at time {time}")
            continue
        if indices.min() < 0 or indices.max() >= len(points):
            defects.append(f"{name}: face index out of range at time {time}")
        lower, upper = box(points)
        if time.IsDefault() and not PLAUSIBLE_SIZE_M[0] <= (upper - lower).max() <= PLAUSIBLE_SIZE_M[1]:
            defects.append(f"{name}: {(upper - lower).max():.3g} m is not a person's size")
        extent = np.array(mesh.GetExtentAttr().Get(time))
        if extent.shape != (2, 3) or (extent[0] > lower + 1e-5).any() or (extent[1] < upper - 1e-5).any():
            defects.append(f"{name}: extent does not contain the points at time {time}")
    colours = mesh.GetDisplayColorAttr().Get() or []
    if len(colours) != len(mesh.GetPointsAttr().Get(Usd.TimeCode.EarliestTime())):
        defects.append(f"{name}: {len(colours)} display colours for its points")
    return defects + _uv_defects(mesh, corners)


def _uv_defects(mesh: UsdGeom.Mesh, corners: int) -> list[str]:
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    if not st or st.GetInterpolation() != UsdGeom.Tokens.faceVarying:
        return [f"{mesh.GetPath()}: no face-varying texture coordinates"]
    values, indices = np.array(st.Get()), np.array(st.GetIndices())
    if len(indices) != corners:
        return [f"{mesh.GetPath()}: {len(indices)} texture coordinates for {corners} face corners"]
    if indices.min() < 0 or indices.max() >= len(values):
        return [f"{mesh.GetPath()}: texture coordinate index out of range"]
    if not ((values >= 0) & (values <= 1)).all():
        return [f"{mesh.GetPath()}: texture coordinates outside [0, 1]"]
    return []


def _splat_defects(prim: Usd.Prim) -> list[str]:
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

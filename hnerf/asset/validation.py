"""Validation of USD packages: OpenUSD's own validators, and the data errors that they do not look for."""

from pathlib import Path
from typing import Any

import numpy as np
from pxr import Tf, Usd, UsdGeom, UsdSkel, UsdValidation

from hnerf.errors import InvalidAsset

PLAUSIBLE_SIZE_M = (0.5, 3.0)  # longest side of the box around a person, from lying down to raised arms


def validate_package(path: Path) -> dict[str, Any]:
    """Return the warnings and notes of OpenUSD's validators. Raises InvalidAsset on their errors and on
    `data_defects`."""
    stage = Usd.Stage.Open(str(path))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    findings: dict[str, list[str]] = {"Error": [], "Warn": [], "Info": []}
    for finding in UsdValidation.ValidationContext(validators).Validate(stage):
        findings[finding.GetType().name].append(finding.GetErrorAsString())
    defects = findings.pop("Error") + data_defects(stage)
    if defects:
        raise InvalidAsset(f"{path}: {'; '.join(defects)}")
    return {"validators": len(validators), "warnings": findings["Warn"], "infos": findings["Info"]}


def data_defects(stage: Usd.Stage) -> list[str]:
    """Return one line for each defect in units, meshes, skinning and skeletons."""
    defects = []
    if UsdGeom.GetStageMetersPerUnit(stage) != 1.0:
        defects.append(f"metersPerUnit is {UsdGeom.GetStageMetersPerUnit(stage)}, not 1")
    if UsdGeom.GetStageUpAxis(stage) != UsdGeom.Tokens.y:
        defects.append(f"up axis is {UsdGeom.GetStageUpAxis(stage)}, not Y")
    found = 0
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            found += 1
            defects += _mesh_defects(UsdGeom.Mesh(prim))
            if prim.HasAPI(UsdSkel.BindingAPI):
                defects += _skin_defects(prim)
        elif prim.IsA(UsdSkel.Skeleton):
            defects += _skeleton_defects(UsdSkel.Skeleton(prim))
        elif prim.IsA(UsdSkel.Animation):
            defects += _animation_defects(UsdSkel.Animation(prim))
    return defects if found else [*defects, "has no mesh"]


def _mesh_defects(mesh: UsdGeom.Mesh) -> list[str]:
    name = mesh.GetPath()
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get())
    corners = int(np.sum(mesh.GetFaceVertexCountsAttr().Get()))
    defects = [] if corners == len(indices) else [f"{name}: {corners} face corners but {len(indices)} indices"]
    for time in _samples(mesh.GetPointsAttr()):
        points = np.array(mesh.GetPointsAttr().Get(time))
        if not np.isfinite(points).all():
            defects.append(f"{name}: points are not finite at time {time}")
            continue
        if indices.min() < 0 or indices.max() >= len(points):
            defects.append(f"{name}: face index out of range at time {time}")
        lower, upper = points.min(0), points.max(0)
        if not PLAUSIBLE_SIZE_M[0] <= (upper - lower).max() <= PLAUSIBLE_SIZE_M[1]:
            defects.append(f"{name}: {(upper - lower).max():.3g} m is not a person's size, at time {time}")
        extent = np.array(mesh.GetExtentAttr().Get(time))
        if extent.shape != (2, 3) or (extent[0] > lower + 1e-5).any() or (extent[1] < upper - 1e-5).any():
            defects.append(f"{name}: extent does not contain the points at time {time}")
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


def _skin_defects(prim: Usd.Prim) -> list[str]:
    name, binding = prim.GetPath(), UsdSkel.BindingAPI(prim)
    skeleton = binding.GetInheritedSkeleton()
    if not skeleton:
        return [f"{name}: bound to no skeleton"]
    joints = np.array(binding.GetJointIndicesPrimvar().Get())
    weights = np.array(binding.GetJointWeightsPrimvar().Get())
    influences = binding.GetJointWeightsPrimvar().GetElementSize()
    vertices = len(UsdGeom.Mesh(prim).GetPointsAttr().Get(Usd.TimeCode.EarliestTime()))
    if not len(joints) == len(weights) == vertices * influences:
        return [f"{name}: {len(joints)} joint indices and {len(weights)} weights for {vertices} x {influences}"]
    defects = []
    if joints.min() < 0 or joints.max() >= len(skeleton.GetJointsAttr().Get()):
        defects.append(f"{name}: joint index out of range")
    # Negated conditions, so that NaN fails.
    if not ((weights >= 0).all() and (np.abs(weights.reshape(vertices, influences).sum(1) - 1) < 1e-4).all()):
        defects.append(f"{name}: joint weights are negative, not finite, or do not sum to 1")
    return defects


def _skeleton_defects(skeleton: UsdSkel.Skeleton) -> list[str]:
    name, joints = skeleton.GetPath(), skeleton.GetJointsAttr().Get()
    defects = []
    if not all(Tf.IsValidIdentifier(part) for joint in joints for part in joint.split("/")):
        defects.append(f"{name}: joint names are not identifiers")
    if len(set(joints)) != len(joints):
        defects.append(f"{name}: joint names are not unique")
    for attribute in (skeleton.GetRestTransformsAttr(), skeleton.GetBindTransformsAttr()):
        transforms = np.array(attribute.Get())
        if len(transforms) != len(joints) or not np.isfinite(transforms).all():
            defects.append(f"{name}: {attribute.GetName()} is not finite or does not have one matrix per joint")
    return defects


def _animation_defects(animation: UsdSkel.Animation) -> list[str]:
    defects = []
    joints = len(animation.GetJointsAttr().Get())
    for time in _samples(animation.GetRotationsAttr()):
        rotations = np.array([(q.GetReal(), *q.GetImaginary()) for q in animation.GetRotationsAttr().Get(time)])
        translations = np.array(animation.GetTranslationsAttr().Get(time))
        if not len(rotations) == len(translations) == joints:
            defects.append(f"{animation.GetPath()}: does not have one transform per joint at time {time}")
        elif not (np.isfinite(translations).all() and (np.abs(np.linalg.norm(rotations, axis=1) - 1) < 1e-4).all()):
            defects.append(f"{animation.GetPath()}: quaternions are not finite or not of unit length at time {time}")
    return defects


def _samples(attribute: Usd.Attribute) -> list[Usd.TimeCode]:
    return [Usd.TimeCode(t) for t in attribute.GetTimeSamples()] or [Usd.TimeCode.Default()]

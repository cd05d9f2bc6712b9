"""Defects of skeletons, skins, blend shapes and motions that OpenUSD's validators do not check."""

import numpy as np
from pxr import Tf, Usd, UsdGeom, UsdSkel

from hnerf.asset.rigs import GAME, GAME_INFLUENCES
from hnerf.asset.staging import CAPTURED, RATES, box
from hnerf.body.skeletons import OWN, PELVIS, ROOT

SAME = 1e-4  # metres, or parts of 1, by which values that must agree may differ
ON_GROUND_M = 1e-3  # height by which the captured body's lowest point may be off the ground
ON_GROUND_CHANGED_M = 1e-2  # the same for lower levels of detail and other shapes
EYE_OFF = 0.1  # by which an eye's joint may be off the centre of its eyeball, over the eyeball's radius


def skin_defects(prim: Usd.Prim) -> list[str]:
    """Return the defects of a mesh's skin weights and blend shapes."""
    name, binding = prim.GetPath(), UsdSkel.BindingAPI(prim)
    skeleton = binding.GetInheritedSkeleton()
    if not skeleton:
        return [f"{name}: bound to no skeleton"]
    joints = np.array(binding.GetJointIndicesPrimvar().Get())
    weights = np.array(binding.GetJointWeightsPrimvar().Get())
    influences = binding.GetJointWeightsPrimvar().GetElementSize()
    points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(Usd.TimeCode.EarliestTime()))
    vertices = len(points)
    if not len(joints) == len(weights) == vertices * influences:
        return [f"{name}: {len(joints)} joint indices and {len(weights)} weights for {vertices} x {influences}"]
    defects, tokens = _shape_defects(prim, vertices), skeleton.GetJointsAttr().Get()
    if joints.min() < 0 or joints.max() >= len(tokens):
        return [*defects, f"{name}: joint index out of range"]
    # Negated conditions, so that NaN fails.
    if not ((weights >= 0).all() and (np.abs(weights.reshape(vertices, influences).sum(1) - 1) < 1e-4).all()):
        defects.append(f"{name}: joint weights are negative, not finite, or do not sum to 1")
    own = _own_names(skeleton)
    used = {own[j] for j in np.unique(joints[weights > 0]).tolist()}
    if len(used & {"eye_L", "eye_R"}) == 1:
        defects.append(f"{name}: skin follows one eye and not the other")
    stage = prim.GetStage()
    as_captured = _selected(stage, "lod") in ("", "lod0") and _selected(stage, "shape") in ("", CAPTURED)
    if as_captured:
        off = _eyes_off(points, joints.reshape(vertices, -1), weights.reshape(vertices, -1), skeleton)
        defects += [f"{name}: {eye} does not turn about the middle of its ball" for eye in off]
    if not abs(points[:, 1].min()) < (ON_GROUND_M if as_captured else ON_GROUND_CHANGED_M):
        defects.append(f"{name}: its lowest point at rest is at height {points[:, 1].min():.3g} m, not on the ground")
    if _selected(stage, "rig") == GAME and influences > GAME_INFLUENCES:
        defects.append(f"{name}: {influences} influences; the game rig has at most {GAME_INFLUENCES}")
    return defects


def _eyes_off(points: np.ndarray, joints: np.ndarray, weights: np.ndarray, skeleton: UsdSkel.Skeleton) -> list[str]:
    """Return the names of the eyes whose joints are off the centre of the points (V, 3) that follow them. joints,
    weights (V, K)."""
    off = []
    binds = skeleton.GetBindTransformsAttr().Get()
    names = _own_names(skeleton)
    for j, (name, bind) in enumerate(zip(names, binds, strict=False)):  # `skeleton_defects` compares their numbers
        if name.startswith("eye_") and len(ball := points[((joints == j) & (weights > 0)).any(1)]):
            low, high = box(ball)
            if np.linalg.norm(bind.ExtractTranslation() - (low + high) / 2) > EYE_OFF * (high - low).min() / 2:
                off.append(name)
    return off


def _shape_defects(prim: Usd.Prim, vertices: int) -> list[str]:
    """Return the defects of a mesh's blend shapes."""
    binding = UsdSkel.BindingAPI(prim)
    names = binding.GetBlendShapesAttr().Get() or []
    targets = binding.GetBlendShapeTargetsRel().GetTargets()
    if len(names) != len(targets):
        return [f"{prim.GetPath()}: {len(names)} blend shapes but {len(targets)} targets"]
    for target in targets:
        shape = UsdSkel.BlendShape(prim.GetStage().GetPrimAtPath(target))
        offsets, points = (
            np.array(attribute.Get() or []) for attribute in (shape.GetOffsetsAttr(), shape.GetPointIndicesAttr())
        )
        if offsets.shape != (len(points) or vertices, 3) or not np.isfinite(offsets).all():
            return [f"{target}: offsets are not finite or not one a point"]
        if len(points) and not 0 <= points.min() <= points.max() < vertices:
            return [f"{target}: point index out of range"]
    return []


def _own_names(skeleton: UsdSkel.Skeleton) -> list[str]:
    """Return the exported names of a skeleton's joints, whichever names they have in the file."""
    own = (skeleton.GetPrim().GetCustomDataByKey("jointNamesIn") or {}).get(OWN, {})
    return [own.get(name, name) for name in (joint.rpartition("/")[2] for joint in skeleton.GetJointsAttr().Get())]


def skeleton_defects(skeleton: UsdSkel.Skeleton) -> list[str]:
    """Return the defects of a skeleton's joints and of their transforms at rest."""
    name, joints = skeleton.GetPath(), skeleton.GetJointsAttr().Get()
    defects = []
    if not all(Tf.IsValidIdentifier(part) for joint in joints for part in joint.split("/")):
        defects.append(f"{name}: joint names are not identifiers")
    if len(set(joints)) != len(joints):
        defects.append(f"{name}: joint names are not unique")
    rest, bind = (np.array(a.Get()) for a in (skeleton.GetRestTransformsAttr(), skeleton.GetBindTransformsAttr()))
    for what, transforms in (("restTransforms", rest), ("bindTransforms", bind)):
        if len(transforms) != len(joints) or not np.isfinite(transforms).all():
            defects.append(f"{name}: {what} is not finite or does not have one matrix per joint")
    return defects or _rest_defects(skeleton, list(joints), rest, bind)


def _rest_defects(skeleton: UsdSkel.Skeleton, joints: list[str], rest: np.ndarray, bind: np.ndarray) -> list[str]:
    """Return the defects of transforms at rest (J, 4, 4), for row vectors: `rest` to parents, `bind` to the stage."""
    name, defects = skeleton.GetPath(), []
    turns = bind[:, :3, :3]
    right_handed = np.linalg.det(turns) > 0
    if not (np.abs(turns @ turns.swapaxes(1, 2) - np.eye(3)).max() < SAME and right_handed.all()):
        defects.append(f"{name}: bindTransforms are no rotations")
    above = [joints.index(j.rpartition("/")[0]) if j.rpartition("/")[0] in joints else -1 for j in joints]
    composed = [rest[j] @ bind[p] if p >= 0 else rest[j] for j, p in enumerate(above)]
    if np.abs(np.array(composed) - bind).max() > SAME:
        defects.append(f"{name}: restTransforms do not compose to bindTransforms")
    names = _own_names(skeleton)
    pelvis = names.index(PELVIS) if PELVIS in names else 0
    if names[0] != ROOT or above[pelvis] != 0 or np.abs(bind[0] - np.eye(4)).max() > SAME:
        defects.append(f"{name}: no {ROOT} on the ground with a {PELVIS} below it")
    elif np.abs(bind[pelvis, 3, [0, 2]]).max() > SAME:
        defects.append(f"{name}: {ROOT} does not stand below {PELVIS} at rest")
    if not skeleton.GetPrim().GetCustomDataByKey("restPose"):
        defects.append(f"{name}: does not name its rest pose")
    return defects


def animation_defects(animation: UsdSkel.Animation) -> list[str]:
    """Return the defects of a motion."""
    name, defects = animation.GetPath(), []
    joints = len(animation.GetJointsAttr().Get())
    for time in samples(animation.GetRotationsAttr()):
        rotations = np.array(animation.GetRotationsAttr().Get(time))  # (J, 4)
        translations = np.array(animation.GetTranslationsAttr().Get(time))
        if not len(rotations) == len(translations) == joints:
            defects.append(f"{name}: does not have one transform per joint at time {time}")
        elif not (np.isfinite(translations).all() and (np.abs(np.linalg.norm(rotations, axis=1) - 1) < 1e-4).all()):
            defects.append(f"{name}: quaternions are not finite or not of unit length at time {time}")
        weights = np.array(animation.GetBlendShapeWeightsAttr().Get(time) or [])
        if (
            len(weights) != len(animation.GetBlendShapesAttr().Get() or [])
            or not ((weights >= 0) & (weights <= 1)).all()
        ):
            defects.append(f"{name}: blend shape weights are not one a shape from 0 to 1 at time {time}")
    return defects + _rate_defects(animation)


def _rate_defects(animation: UsdSkel.Animation) -> list[str]:
    """Return a defect if a motion that was resampled at a rate is not sampled at that rate's whole frames."""
    stage = animation.GetPrim().GetStage()
    rates = {f"{CAPTURED}_{rate}": rate for rate in RATES}
    rate = rates.get(_selected(stage, "motion"))
    if rate is None:
        return []
    frames = np.array(animation.GetRotationsAttr().GetTimeSamples()) * rate / stage.GetTimeCodesPerSecond()
    whole = len(frames) > 0 and np.abs(frames - np.round(frames)).max() < SAME and (np.diff(frames) < 1 + SAME).all()
    return [] if whole else [f"{animation.GetPath()}: is not sampled at every frame of {rate} a second"]


def _selected(stage: Usd.Stage, variants: str) -> str:
    """Return the root prim's selected variant of a set."""
    root = stage.GetDefaultPrim()
    return root.GetVariantSet(variants).GetVariantSelection() if root else ""


def samples(attribute: Usd.Attribute) -> list[Usd.TimeCode]:
    """Return the times at which an attribute has values; the default time if there are none."""
    return [Usd.TimeCode(t) for t in attribute.GetTimeSamples()] or [Usd.TimeCode.Default()]

"""Stages of studies: degradations of other stages' results, and checks of surfaces."""

import dataclasses
import json
import shutil
from pathlib import Path

import trimesh

from hnerf.avatar.trained import load_avatar
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.evaluation.ground_truth import GroundTruth
from hnerf.study.degradations.catalogue import Degradation
from hnerf.study.degradations.fit import extreme_poses
from hnerf.study.surface import SurfaceCheck, check_pose, check_surface
from tasks.calibration import calibrated_capture
from tasks.source import Source, require_unchanged
from tasks.stage import stage
from tasks.store import Artifact

EXTREME_POSES = 3  # checked for each strength and seed


@stage("study-capture", version="7")
def degrade_capture(out: Path, recording: Artifact, degradation: Degradation) -> dict[str, float]:
    """Write a degraded capture in the format that `ingest` writes."""
    degradation.apply(Capture.load(recording.root), out=out)
    return {}


@stage("study-worn", version="3")
def degrade_clothing(
    out: Path, truth: Source, recording: Artifact, calibration: Artifact, body: Artifact, degradation: Degradation
) -> dict[str, float]:
    """Write a capture whose person wears added clothes or hair, and its ground truth with them under
    `ground_truth/`."""
    capture = calibrated_capture(recording, calibration)
    degradation.apply(capture, BodyFit.load(body.root), GroundTruth(truth.root, capture), out=out)
    require_unchanged(truth)
    return {}


@stage("study-masks", version="3")
def degrade_masks(
    out: Path, recording: Artifact, calibration: Artifact, segmentation: Artifact, degradation: Degradation
) -> dict[str, float]:
    """Write degraded masks."""
    degradation.apply(Masks.load(segmentation.root), calibrated_capture(recording, calibration)).save(out)
    return {}


@stage("study-fit", version="1")
def degrade_fit(out: Path, body: Artifact, degradation: Degradation) -> dict[str, float]:
    """Write a degraded body fit, with the report of the good one."""
    degradation.apply(BodyFit.load(body.root)).save(out)
    shutil.copyfile(body.root / "report.json", out / "report.json")
    return {}


@stage("study-surface", version="2")
def check_meshes(out: Path, report: Artifact, body: Artifact) -> dict[str, float]:
    """Check each mesh of an evaluation against the body of a good fit, and write `surface.json`."""
    good = BodyFit.load(body.root)
    bodies_m, faces = good.vertices_m().numpy(), good.rig.faces.numpy()
    paths = sorted((report.root / "meshes").glob("*.ply"))
    # process=False: merging vertices may open a surface.
    meshes = {path.stem: trimesh.load_mesh(path, process=False) for path in paths}
    return _save(
        {name: check_surface(mesh, bodies_m[good.index(int(name))], faces) for name, mesh in meshes.items()}, out
    )


@stage("study-poses", version="1")
def show_in_extreme_poses(out: Path, training: Artifact, degradation: Degradation) -> dict[str, float]:
    """Check the surface of a trained person in poses far from the recorded ones, and write `surface.json`."""
    avatar = load_avatar(training.root)
    poses = extreme_poses(avatar.body, degradation.strength, EXTREME_POSES, degradation.rng)
    return _save({f"pose {k}": check_pose(avatar, *pose) for k, pose in enumerate(zip(*poses, strict=True))}, out)


def _save(checks: dict[str, SurfaceCheck], out: Path) -> dict[str, float]:
    plain = {name: dataclasses.asdict(check) for name, check in checks.items()}
    (out / "surface.json").write_text(json.dumps(plain, indent=1))
    return {"faults": sum(check.fault is not None for check in checks.values())}

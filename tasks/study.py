"""What studies do to a capture between the stages."""

import dataclasses
import json
import shutil
from pathlib import Path

import trimesh

from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.evaluation.ground_truth import GroundTruth
from hnerf.study.degradations.catalogue import Degradation
from hnerf.study.degradations.catalogue import degrade_capture as write_degraded
from hnerf.study.degradations.catalogue import degrade_clothing as write_dressed
from hnerf.study.degradations.catalogue import degrade_fit as disturbed
from hnerf.study.degradations.catalogue import degrade_masks as degraded
from hnerf.study.degradations.fit import extreme_poses
from hnerf.study.surface import SurfaceCheck, check_pose, check_surface
from tasks.calibration import calibrated
from tasks.source import Source
from tasks.stage import stage
from tasks.store import Artifact
from tasks.training import trained

EXTREME_POSES = 3  # shown of each strength and seed


@stage("study-capture", version="2")
def degrade_capture(out: Path, recording: Artifact, degradation: Degradation) -> dict[str, float]:
    """A capture made worse; what `ingest` would have written of it."""
    write_degraded(Capture.load(recording.root), degradation, out)
    return {}


@stage("study-worn", version="1")
def degrade_clothing(
    out: Path, truth: Source, recording: Artifact, calibration: Artifact, body: Artifact, degradation: Degradation
) -> dict[str, float]:
    """A capture whose person wears more than was recorded, and under `ground_truth/` what is known to be true of it."""
    capture = calibrated(recording, calibration)
    write_dressed(capture, BodyFit.load(body.root), GroundTruth(truth.root, capture), degradation, out)
    return {}


@stage("study-masks", version="1")
def degrade_masks(
    out: Path, recording: Artifact, calibration: Artifact, segmentation: Artifact, degradation: Degradation
) -> dict[str, float]:
    """Masks made worse."""
    degraded(Masks.load(segmentation.root), calibrated(recording, calibration), degradation).save(out)
    return {}


@stage("study-fit", version="1")
def degrade_fit(out: Path, body: Artifact, degradation: Degradation) -> dict[str, float]:
    """A fitted body made worse; the report is that of the good fit."""
    disturbed(BodyFit.load(body.root), degradation).save(out)
    shutil.copyfile(body.root / "report.json", out / "report.json")
    return {}


@stage("study-surface", version="2")
def check_meshes(out: Path, report: Artifact, body: Artifact) -> dict[str, float]:
    """Whether each mesh of an evaluation is a person's, next to the bodies of a good fit: `surface.json`."""
    good = BodyFit.load(body.root)
    bodies_m, faces = good.vertices_m().numpy(), good.rig.faces.numpy()
    paths = sorted((report.root / "meshes").glob("*.ply"))
    meshes = {path.stem: trimesh.load_mesh(path, process=False) for path in paths}  # merged vertices may open a surface
    return _save(
        {name: check_surface(mesh, bodies_m[good.index(int(name))], faces) for name, mesh in meshes.items()}, out
    )


@stage("study-poses", version="1")
def show_in_extreme_poses(out: Path, training: Artifact, degradation: Degradation) -> dict[str, float]:
    """Whether a trained person keeps a person's surface in poses that nobody recorded: `surface.json`."""
    avatar = trained(training)
    poses = extreme_poses(avatar.body, degradation.strength, EXTREME_POSES, degradation.rng)
    return _save({f"pose {k}": check_pose(avatar, *pose) for k, pose in enumerate(zip(*poses, strict=True))}, out)


def _save(checks: dict[str, SurfaceCheck], out: Path) -> dict[str, float]:
    plain = {name: dataclasses.asdict(check) for name, check in checks.items()}
    (out / "surface.json").write_text(json.dumps(plain, indent=1))
    return {"faults": sum(check.fault is not None for check in checks.values())}

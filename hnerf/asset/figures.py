"""Figures of the asset for its report."""

from collections.abc import Iterable
from functools import reduce
from typing import Any

import numpy as np
import trimesh

from hnerf.asset.correctives import Correctives
from hnerf.asset.registration import crossing_faces
from hnerf.asset.rigs import FULL, GAME, posed_frames
from hnerf.asset.skinning import skinned
from hnerf.asset.splats import Splats
from hnerf.asset.staging import CAPTURED, StagedAvatar
from hnerf.asset.topologies import AssetMesh
from hnerf.geometry.mesh_queries import Surface

SAMPLES = 20_000  # points on each mesh


def mesh_figures(topology: str, mesh: AssetMesh, staged: StagedAvatar) -> dict[str, Any]:
    """Return the size of the asset's mesh, and how many faces of its skin cross others. topology: its name."""
    skin = mesh.trimesh.faces[: mesh.skin_faces]
    return {
        "topology": topology,
        "vertices": len(mesh.rig.vertices_m),
        "faces": len(mesh.rig.faces),
        "watertight": mesh.trimesh.is_watertight,
        "crossing_faces": int(crossing_faces(mesh.trimesh.vertices, skin).sum()),
        "height_m": float(np.ptp(staged.rest_points_m[:, 1])),
    }


def level_figures(staged: StagedAvatar) -> dict[str, dict[str, float]]:
    """Return the size of each level of detail, and the mean and the 99th percentile of the distance between its surface
    at rest and that of lod0, sampled on both."""
    meshes = [trimesh.Trimesh(staged.rest_points_m[lv.vertices], lv.faces, process=False) for lv in staged.levels]
    found: dict[str, dict[str, float]] = {}
    for level, mesh in enumerate(meshes):
        found[f"lod{level}"] = {"vertices": len(mesh.vertices), "triangles": len(mesh.faces)}
        if level:
            distance_mm = 1e3 * np.concatenate([_distances_m(*pair) for pair in ((mesh, meshes[0]), (meshes[0], mesh))])
            found[f"lod{level}"]["to_lod0_mean_mm"] = float(distance_mm.mean())
            found[f"lod{level}"]["to_lod0_p99_mm"] = float(np.percentile(distance_mm, 99))
    return found


def _distances_m(mesh: trimesh.Trimesh, other: trimesh.Trimesh) -> np.ndarray:
    """Return the distances of points on one mesh from another, (SAMPLES,)."""
    points_m, _ = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)
    return Surface(other).closest(points_m)[0]


def rig_figures(staged: StagedAvatar, name: str) -> dict[str, float]:
    """Return a rig's size, and how far it moves points of the captured surfaces from where the full rig has them: the
    99th percentile and the maximum over points, each in its worst frame."""
    rig, full = staged.rigs[name], staged.rigs[FULL]
    surfaces = [] if rig is full else [one.surfaces_m(CAPTURED, staged.rest) for one in (rig, full)]
    off_m = (moved - true for moved, true in zip(*surfaces, strict=True))
    return {"joints": len(rig.skeleton.names), "influences": rig.skin.influences} | _moved_mm(off_m)


def splat_figures(staged: StagedAvatar, splats: Splats) -> dict[str, float]:
    """Return the number of splats, their sigma along the surface, and how far their own skin moves them from the
    captured surfaces, as in `rig_figures`."""
    game, full = staged.rigs[GAME], staged.rigs[FULL]
    skin, weights = splats.skin(game), game.motions[CAPTURED].shape_weights
    poses = posed_frames(game.skeleton, game.stage(CAPTURED), staged.rest, weights)
    off_m = (
        skinned(transforms, skin, splats.at(points_m)) - splats.at(surface_m)
        for (transforms, points_m), surface_m in zip(poses, full.surfaces_m(CAPTURED, staged.rest), strict=True)
    )
    return {"count": len(splats.face), "sigma_mm": 1e3 * splats.sigma_m} | _moved_mm(off_m)


def _moved_mm(off_m: Iterable[np.ndarray]) -> dict[str, float]:
    """Return the 99th percentile and the maximum over points, each in its worst frame. off_m: (V, 3) of each frame."""
    worst_m = reduce(np.maximum, (np.linalg.norm(m, axis=1) for m in off_m), np.zeros(1))
    return {"moved_p99_mm": float(1e3 * np.percentile(worst_m, 99)), "moved_max_mm": float(1e3 * worst_m.max())}


def beyond_skinning_mm(displacements_m: np.ndarray, correctives: Correctives) -> dict[str, float]:
    """Return the root mean square distance of the frames' surfaces from the skinned surface, without and with
    correctives."""
    rebuilt_m = np.einsum("nk,kvd->nvd", correctives.weights, correctives.offsets_m)
    left_m = {"skinned": displacements_m, "with_correctives": displacements_m - rebuilt_m}
    return {name: float(1e3 * np.sqrt((m**2).sum(-1).mean())) for name, m in left_m.items()}

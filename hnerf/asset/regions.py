"""Distances of an asset's meshes from the surface of the field, by region of the body."""

from collections.abc import Mapping

import numpy as np
import trimesh

from hnerf.asset.registration import crossing_faces
from hnerf.asset.topologies import AssetMesh
from hnerf.body.rig import Rig
from hnerf.evaluation.geometry import outer_samples
from hnerf.geometry.mesh_queries import Surface

SAMPLES = 20_000
REGIONS = {  # by prefixes of joint names; all other joints belong to the torso
    "head": ("head", "neck", "eye", "jaw"),
    "arms": ("upperarm", "lowerarm"),
    "hands": ("wrist", "hand", "metacarpal", "finger"),
    "legs": ("upperleg", "lowerleg"),
    "feet": ("foot", "toe"),
}
UNCLOTHED = ("hands", "feet")  # the captured mesh would be no gain for these alone
LIMIT_MM = 10.0  # of the 95th percentile in a region: thick cloth stands about this far from the skin

Distances = dict[str, dict[str, float]]


def region_of(joint_name: str) -> str:
    """Return the region that a joint's skin belongs to."""
    return next((region for region, starts in REGIONS.items() if joint_name.startswith(starts)), "torso")


def surface_distances_mm(dense: trimesh.Trimesh, meshes: Mapping[str, AssetMesh]) -> dict[str, Distances]:
    """Return, by topology, the mean and the 95th percentile of the distances from the outside of the field's surface to
    the mesh, for the whole ("all") and by region of the registered mesh."""
    points_m, _ = outer_samples(Surface(dense), SAMPLES, np.random.default_rng(0))
    surfaces = {name: Surface(mesh.trimesh) for name, mesh in meshes.items()}
    rig, (_, face) = meshes["registered"].rig, surfaces["registered"].closest(points_m)
    region = _vertex_regions(rig)[surfaces["registered"].mesh.faces[face][:, 0]]
    found: dict[str, Distances] = {}
    for name, surface in surfaces.items():
        distance_mm = 1e3 * surface.closest(points_m)[0]
        parts = {"all": distance_mm} | {r: distance_mm[region == r] for r in ("torso", *REGIONS)}
        found[name] = {r: _summary(values) for r, values in parts.items() if len(values)}
    return found


def chosen_topology(wanted: str, registered_mm: Distances) -> str:
    """Return the topology of the asset's first mesh. wanted: `asset.topology`; registered_mm: the distances of the
    registered mesh."""
    if wanted == "auto":
        return "captured" if set(_not_followed(registered_mm)) - set(UNCLOTHED) else "registered"
    return "registered" if wanted == "both" else wanted


def findings(wanted: str, registered_mm: Distances) -> list[str]:
    """Return a line for each region in which the registered mesh does not follow the surface, unless the captured mesh
    was asked for. wanted, registered_mm: see `chosen_topology`."""
    falls_back = wanted == "auto" and chosen_topology(wanted, registered_mm) == "captured"
    captured = "The asset has the captured mesh" if falls_back else "asset.topology=captured follows them"
    return [
        f"{region}: 5 % of the surface is more than {registered_mm[region]['p95']:.0f} mm from the registered mesh; "
        f"loose clothes or long hair? {captured}"
        for region in (_not_followed(registered_mm) if wanted != "captured" else [])
    ]


def crossing_findings(mesh: AssetMesh) -> list[str]:
    """Return a line if faces of the head cross others, as at the eyes, where this leaves holes."""
    skin = mesh.rig.faces.numpy()[: mesh.skin_faces]
    crossing = skin[crossing_faces(mesh.trimesh.vertices, skin)]
    count = int((_vertex_regions(mesh.rig)[crossing[:, 0]] == "head").sum())
    return [f"head: {count} faces cross others; look for holes in the clay images of report.html"] if count else []


def _vertex_regions(rig: Rig) -> np.ndarray:
    """Return the region of each vertex, that of its strongest joint, (V,)."""
    return np.array([region_of(name) for name in rig.joint_names])[rig.dense_weights.argmax(1).numpy()]


def _not_followed(registered_mm: Distances) -> list[str]:
    """Return the regions in which the registered mesh does not follow the surface."""
    return [region for region, d in registered_mm.items() if region != "all" and d["p95"] > LIMIT_MM]


def _summary(distance_mm: np.ndarray) -> dict[str, float]:
    return {"mean": float(distance_mm.mean()), "p95": float(np.percentile(distance_mm, 95))}

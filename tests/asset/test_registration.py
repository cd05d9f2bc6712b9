import dataclasses

import numpy as np
import pytest
import trimesh

from hnerf.asset.plate import ThinPlate
from hnerf.asset.registration import _loosened, _match, crossing_faces, register
from hnerf.asset.rig_transfer import clothed_rig
from hnerf.body.base_mesh import BaseMesh, base_mesh
from hnerf.geometry.mesh_queries import Surface
from tests.asset.figure import column_rig, twice, upright_column


def bare(mesh: trimesh.Trimesh) -> BaseMesh:
    """Return a mesh as a body's base mesh in which every face is skin."""
    return base_mesh(clothed_rig(column_rig(), mesh))


def test_registration_moves_a_column_onto_the_surface_around_it() -> None:
    body = base_mesh(column_rig())
    found = register(body, upright_column(0.17, -0.02, 1.62))
    radius_m, height_m = np.linalg.norm(found.vertices_m[:, :2], axis=1), found.vertices_m[:, 2]
    side = (height_m > 0.2) & (height_m < 1.4) & (radius_m > 0.1)
    assert side.sum() > 200
    np.testing.assert_allclose(radius_m[side], 0.17, atol=0.0015)
    assert found.trust[side].min() > 0.7  # 2 cm is a third of the Geman-McClure scale, 6 cm
    assert not crossing_faces(found.vertices_m, body.rig.faces.numpy()[: body.skin_faces]).any()


def test_hidden_vertices_follow_their_neighbours() -> None:
    body = base_mesh(column_rig())
    hidden = np.zeros(len(body.hidden), bool)
    hidden[np.abs(body.rig.vertices_m[:, 2].numpy() - 0.8) < 0.02] = True
    found = register(dataclasses.replace(body, hidden=hidden), upright_column(0.17, -0.02, 1.62))
    assert (found.trust[hidden] == 0).all()
    np.testing.assert_allclose(np.linalg.norm(found.vertices_m[hidden, :2], axis=1), 0.17, atol=0.003)


def test_trust_in_a_match_falls_with_distance_and_opposite_normals() -> None:
    """A match at the distance of the scale keeps a quarter of its trust (Geman-McClure). It keeps none if the normals
    are opposite."""
    inner, outer = upright_column(0.15, 0.0, 1.6), Surface(upright_column(0.17, -0.02, 1.62))
    scale_m = np.full(len(inner.vertices), 0.02)
    sides = (np.abs(inner.vertices[:, 2] - 0.8) < 0.5) & (np.linalg.norm(inner.vertices[:, :2], axis=1) > 0.1)
    closest_m, trust = _match(inner.vertices, inner.faces, outer, scale_m)
    np.testing.assert_allclose(trust[sides], 0.25, atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(closest_m[sides, :2], axis=1), 0.17, atol=0.002)
    _, inside_out = _match(inner.vertices, inner.faces[:, [0, 2, 1]], outer, scale_m)
    assert (inside_out == 0).all()


def test_two_fingers_stay_apart_in_a_mitten() -> None:
    finger = trimesh.creation.capsule(height=0.05, radius=0.008, count=[12, 12]).subdivide()
    fingers = twice(finger, (0.019, 0, 0))  # with a gap of 3 mm
    middle_m = [0.0095, 0, 0.025]
    mitten = trimesh.creation.icosphere(subdivisions=4)
    mitten.vertices = mitten.vertices * (0.026, 0.014, 0.045) + middle_m
    found = register(bare(fingers), mitten)
    assert not crossing_faces(found.vertices_m, fingers.faces).any()
    left, right = np.split(found.vertices_m, 2)
    inner = (np.abs(left[:, 1]) < 0.003) & (np.abs(left[:, 2] - 0.025) < 0.02)
    gap_m = right[inner, 0].min() - left[inner, 0].max()
    assert 0.0015 < gap_m < 0.0045
    back = np.abs(found.vertices_m - middle_m) < (0.012, 1, 0.01)
    assert np.abs(found.vertices_m[back.all(1), 1]).max() > 0.01  # finger backs moved onto the mitten's back


def test_intersecting_faces_are_pulled_apart() -> None:
    box = trimesh.creation.box(extents=(0.02, 0.02, 0.02)).subdivide().subdivide()
    boxes = twice(box, (0.0195, 0.001, 0.001))  # they overlap by half a millimetre
    vertices_m, faces = np.asarray(boxes.vertices), np.asarray(boxes.faces)
    assert crossing_faces(vertices_m, faces).any()
    apart_m = _loosened(vertices_m, faces, len(faces), ThinPlate.of(vertices_m, faces))
    assert not crossing_faces(apart_m, faces).any()
    assert np.abs(apart_m - vertices_m).max() < 0.003


def test_a_body_with_an_unknown_mesh_has_no_hidden_vertices() -> None:
    body = base_mesh(column_rig())
    assert body.uvs is None and not body.hidden.any()
    assert body.skin_faces == len(body.rig.faces) == pytest.approx(len(column_rig().faces))

import dataclasses
from typing import Any

import numpy as np
import pytest
import trimesh

from hnerf.asset import registration
from hnerf.asset.plate import ThinPlate
from hnerf.asset.registration import _around, _loosened, _match, crossing_faces, register
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


def test_a_match_that_makes_faces_cross_is_not_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    """One vertex on the column's side is matched with a point beyond the opposite side. It stays with its neighbours,
    on the surface of 17 cm radius."""
    body = base_mesh(column_rig())
    vertices_m, faces = body.rig.vertices_m.numpy(), body.rig.faces.numpy()
    stray = int(np.linalg.norm(vertices_m - (0.15, 0, 0.8), axis=1).argmin())

    def with_a_stray(*given: Any) -> tuple[np.ndarray, np.ndarray]:
        matched_m, trust = _match(*given)
        matched_m[stray], trust[stray] = (-0.4, 0, 0.8), 1
        return matched_m, trust

    monkeypatch.setattr(registration, "_match", with_a_stray)
    found = register(body, upright_column(0.17, -0.02, 1.62))
    assert not crossing_faces(found.vertices_m, faces[: body.skin_faces]).any()
    assert found.trust[stray] == 0
    side = np.linalg.norm(vertices_m[:, :2], axis=1) > 0.1
    assert found.trust[side & (np.abs(np.abs(vertices_m[:, 2] - 0.8) - 0.55) < 0.05)].min() > 0.7
    assert np.linalg.norm(found.vertices_m[stray, :2]) == pytest.approx(0.17, abs=0.003)


def test_matches_are_trusted_where_the_bodys_own_faces_cross(monkeypatch: pytest.MonkeyPatch) -> None:
    boxes = twice(trimesh.creation.box(extents=(0.02, 0.02, 0.02)).subdivide(), (0.0195, 0.001, 0.001))
    around = trimesh.creation.box(bounds=boxes.bounds).subdivide().subdivide()
    trust = register(bare(boxes), around).trust
    monkeypatch.setattr(registration, "RINGS", ())
    np.testing.assert_array_equal(trust, register(bare(boxes), around).trust)
    assert trust[np.unique(boxes.faces[crossing_faces(boxes.vertices, boxes.faces)])].max() > 0.5


def test_rings_of_faces_are_counted_from_shared_corners() -> None:
    """In a strip of triangles 012, 123, 234 and so on, the first one has corners 0 to 2; faces with one of them reach
    corner 4, and those around them corner 6."""
    strip = np.arange(10)[:, None] + np.arange(3)
    assert _around(strip[:1], strip, 2).tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert _around(strip[:0], strip, 2).tolist() == []


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

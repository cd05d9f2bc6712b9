import numpy as np
import pytest
import trimesh

from hnerf.asset.simplify import simplify


def test_a_sphere_with_a_hole_is_closed_and_decimated_in_place() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.5)  # 5120 faces
    pierced = trimesh.Trimesh(sphere.vertices, sphere.faces[1:], process=False)
    assert not pierced.is_watertight
    mesh = simplify(pierced, 1000)
    assert mesh.is_watertight
    assert len(mesh.faces) <= 1000
    assert mesh.volume == pytest.approx(sphere.volume, rel=0.01)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.5).max() < 0.005

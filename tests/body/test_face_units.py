import numpy as np
import pytest
import torch

from hnerf.body.anny import ADULT, anny_rig
from hnerf.body.face_units import face_units_m
from hnerf.body.rig import Rig


def test_face_units_have_arkit_names_and_all_move_vertices(rig: Rig) -> None:
    units = face_units_m(rig)
    assert len(units) == 51 and "tongueOut" not in units
    assert {"jawOpen", "eyeBlinkLeft", "mouthSmileRight", "browInnerUp", "noseSneerLeft", "cheekPuff"} <= set(units)
    assert all(unit.shape == (len(rig.vertices_m), 3) and unit.any() for unit in units.values())


def test_face_units_match_their_names(rig: Rig) -> None:
    units = face_units_m(rig)
    jaw = units["jawOpen"][np.linalg.norm(units["jawOpen"], axis=1).argmax()]
    assert jaw[2] < -0.02 and abs(jaw[0]) < 0.005  # the jaw moves down
    for side, sign in (("Left", 1), ("Right", -1)):
        blink, smile = (units[f"{name}{side}"] for name in ("eyeBlink", "mouthSmile"))
        lid = np.linalg.norm(blink, axis=1).argmax()
        assert sign * rig.vertices_m[lid, 0] > 0.02 and blink[lid, 2] < -0.005
        corner = np.linalg.norm(smile, axis=1).argmax()
        assert sign * rig.vertices_m[corner, 0] > 0.01 and smile[corner, 2] > 0 and sign * smile[corner, 0] > 0
    assert units["jawForward"][:, 1].min() < -0.005
    assert units["jawForward"][:, 1].max() < 0.001


def test_displacements_scale_with_the_size_of_the_face(rig: Rig) -> None:
    beta = torch.tensor(ADULT)
    beta[1] = 0.4
    child = anny_rig(beta)
    face = np.any([moved.any(1) for moved in face_units_m(rig).values()], 0)
    widths_m = [float(np.ptp(body.vertices_m[face, 0].numpy())) for body in (rig, child)]
    (adults, childs) = (face_units_m(body)["jawOpen"] for body in (rig, child))
    scale = childs[adults[:, 2].argmin(), 2] / adults[:, 2].min()
    assert scale == pytest.approx(widths_m[1] / widths_m[0], rel=0.1) and scale < 0.95
    np.testing.assert_allclose(childs, scale * adults, atol=1e-7)

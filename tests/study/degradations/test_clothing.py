from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from hnerf.body.fit_result import BodyFit
from hnerf.capture.body_25 import Body25
from hnerf.capture.capture import Capture, write_image
from hnerf.evaluation.ground_truth import GroundTruth
from hnerf.study.degradations import clothing
from hnerf.study.degradations.clothing import Garment, add_clothing, long_hair, skirt
from tests.body.boxes import box_rig
from tests.study.recording import FRAMES, SIZE_PX, write_detected, write_recording

UP = np.array([0.0, 0.0, 1.0])


def standing() -> np.ndarray:
    """Return keypoints (2, 25, 3) of a person who faces -y in two frames: hips 20 cm apart at 1 m, knees 30 cm at 0.5
    m, ears 16 cm at 1.6 m, the nose in front of them."""
    keypoints_m = np.zeros((2, 25, 3))
    for name, x, y, z in (
        ("R_HIP", -0.1, 0, 1.0), ("L_HIP", 0.1, 0, 1.0), ("R_KNEE", -0.15, 0, 0.5), ("L_KNEE", 0.15, 0, 0.5),
        ("R_EAR", -0.08, 0, 1.6), ("L_EAR", 0.08, 0, 1.6), ("NOSE", 0, -0.1, 1.6),
    ):  # fmt: skip
        keypoints_m[:, Body25[name]] = x, y, z
    return keypoints_m


def test_a_skirt_hangs_from_the_hips_to_the_knees_and_its_folds_move() -> None:
    """Expect a waist of radius 20 cm, the distance between the hips, around (0, 0, 1), and a hem at 0.5 m, 10 + 10 cm,
    plus or minus folds of 3 cm, off the line between the knees. To the left and the right, the hem is measured from
    tanh 2 of either half of that line."""
    made = skirt(standing(), UP, 0.1, np.random.default_rng(0))
    first = made.vertices_m[0]
    rings_m = first[:-2].reshape(clothing.RINGS, clothing.RING_VERTICES, 3)
    assert rings_m[0, :, 2] == pytest.approx(1.0)
    assert rings_m[-1, :, 2] == pytest.approx(0.5)
    assert np.linalg.norm(rings_m[0, :, :2], axis=-1) == pytest.approx(0.2)
    left, back, right, front = rings_m[-1, :: clothing.RING_VERTICES // 4]
    fold_m = back[1] - 0.2  # the same one at every eighth of a turn
    assert 0 < abs(fold_m) < 0.03
    assert (back[0], front[0], front[1]) == pytest.approx((0, 0, -0.2 - fold_m))
    assert (left[0], right[0]) == pytest.approx([s * (0.15 * np.tanh(2) + 0.2 + fold_m) for s in (1, -1)])
    assert np.abs(made.vertices_m[1] - first).max() > 1e-3


def test_a_garment_is_a_closed_surface_facing_outwards() -> None:
    """Around knees that touch, a skirt without flare is a truncated cone with radii of 0.2 and 0.1 m, 0.5 m high.
    Having 64 corners takes off 0.16 %."""
    keypoints_m = standing()
    keypoints_m[:, [Body25.R_KNEE, Body25.L_KNEE], 0] = 0
    made = skirt(keypoints_m, UP, 1e-9, np.random.default_rng(0))
    mesh = trimesh.Trimesh(made.vertices_m[0], made.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(np.pi / 3 * 0.5 * (0.2**2 + 0.2 * 0.1 + 0.1**2), rel=2e-3)


def test_hair_hangs_behind_the_head() -> None:
    """Expect hair down to 40 cm below the ears. Its middle is 0.55 x 16 cm behind them, and 0.15 x 40 cm more at its
    end; it extends 0.35 x 16 cm to the front and the back of that."""
    made = long_hair(standing(), UP, 0.4, np.random.default_rng(0))
    rings_m = made.vertices_m[0][:-2].reshape(clothing.RINGS, clothing.RING_VERTICES, 3)
    assert (rings_m[0, 0, 2], rings_m[-1, 0, 2]) == pytest.approx((1.6, 1.2))
    assert (rings_m[0, :, 1].min(), rings_m[0, :, 1].max()) == pytest.approx((0.032, 0.144))
    assert rings_m[-1, :, 1].mean() == pytest.approx(0.148)
    assert np.ptp(rings_m[0, :, 0]) == pytest.approx(2 * 0.65 * 0.16)
    mesh = trimesh.Trimesh(made.vertices_m[0], made.faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume > 0


def column(keypoints_m: np.ndarray, up: np.ndarray, half_m: float, rng: np.random.Generator) -> Garment:
    """Return an upright tube around (0, 0), from 1.5 to 0.5 m."""
    rings_m = np.zeros((len(keypoints_m), clothing.RINGS, clothing.RING_VERTICES, 3))
    rings_m[..., 2] = np.linspace(1.5, 0.5, clothing.RINGS)[:, None]
    rings_m[..., :2] = half_m * np.concatenate([np.cos(clothing.ANGLES), np.sin(clothing.ANGLES)], 1)
    return Garment.tube(rings_m, np.ones((2, 3)))


def dressed(tmp_path: Path) -> tuple[Capture, GroundTruth]:
    """Draw clothing into the capture of tests/study/recording.py, in which a body of 1 m³ stands in front of camera
    01 and hides a column 0.5 m thick. The ground truth, of frame 2, is a mask of the middle 2 x 2 px of camera 03, and
    a triangle."""
    good = write_recording(tmp_path / "good")
    write_detected(good)
    (good.root / "boards.npz").write_bytes(b"corners")
    folder = good.root / "ground_truth"
    mask = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
    mask[7:9, 7:9] = 255
    write_image(folder / "masks" / "03" / "000002.png", mask)
    np.savez(folder / "meshes.npz", faces=[[0, 1, 2]], vertices=np.eye(3)[None], frames=[2])
    root = torch.eye(4).repeat(len(FRAMES), 1, 1)
    root[:, :3, 3] = torch.tensor([-2.0, -0.5, 0.5])
    body = BodyFit(box_rig(), FRAMES, torch.zeros(len(FRAMES), 2, 3), root)
    add_clothing(column, good, body, GroundTruth(good.root, good), 0.25, np.random.default_rng(0), tmp_path / "bad")
    bad = Capture.load(tmp_path / "bad")
    return bad, GroundTruth(bad.root, bad)


def test_a_garment_is_drawn_where_the_body_does_not_hide_it(tmp_path: Path) -> None:
    """A column 1 m high and 0.5 m wide, 4 m from a camera of 16 px focal length, is about 4 x 2 px around the middle;
    where it is nearest, at 3.75 m, half a metre is 2.13 px."""
    bad, _ = dressed(tmp_path)
    off = {name: np.abs(bad.image(name, 2).astype(int) - 102).max(-1) for name in bad.cameras}
    changed = {name: levels > 40 for name, levels in off.items()}
    assert off["01"].max() <= 3  # JPEG; in the body's shadow, the column would be 40 levels brighter at most
    for name in ("02", "03"):
        assert changed[name][6:10, 7:9].all()
        assert changed[name].sum() == 8
    assert bad.given_mask("02", 2).sum() == 64  # type: ignore[union-attr]  # the middle 8 x 8 px, as before
    likely = bad.person_probability("02", 2)
    assert likely is not None
    assert (likely[6:10, 7:9] == 1).all()
    assert (255 * likely).round().sum() == 8 * 255 + 56 * 200 + 192 * 2
    assert bad.keypoints("02")[0, 0, 1].tolist() == [2, 5, 1]  # type: ignore[index]
    assert bad.background("02").mean() == pytest.approx(50, abs=1)  # type: ignore[union-attr]
    assert not (bad.root / "boards.npz").exists()


def test_a_garment_is_added_to_the_ground_truth_too(tmp_path: Path) -> None:
    bad, truth = dressed(tmp_path)
    assert (truth.has_mask("03", 2), truth.has_mask("03", 4)) == (True, False)
    assert truth.mask("03", 2)[6:10, 7:9].all()
    assert truth.mask("03", 2).sum() == 8
    on_black, _ = truth.on_black("03", 2)
    assert np.abs(on_black.astype(int) - bad.image("03", 2)).max(-1)[6:10, 7:9].max() <= 3  # twice through JPEG
    assert on_black[:2].max() <= 5  # nothing but what JPEG adds
    (mesh,) = truth.meshes().values()
    assert len(mesh.vertices) == clothing.RINGS * clothing.RING_VERTICES + 2 + 3
    assert mesh.vertices[mesh.faces[-1]] == pytest.approx(np.eye(3))

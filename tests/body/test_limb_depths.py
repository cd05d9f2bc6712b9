from pathlib import Path

import numpy as np
import pytest
import torch

from hnerf.body.articulation import Articulation, Pose
from hnerf.body.limb_depths import LIMBS, LimbDepths, observe_limb_depths
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.observations import observe
from hnerf.capture.capture import LANDMARKS
from tests.body.recorded_body import moving_body, record, ring_camera
from tests.body.test_articulation import check_gradient, random_pose
from tests.body.two_bone import two_bone_rig


def along_y(frames: int) -> LimbDepths:
    depth_m, trust = torch.zeros(2, frames, len(LIMBS), dtype=torch.float64)
    return LimbDepths(depth_m, trust + 1, torch.tensor([[0.0, 1, 0]], dtype=torch.float64).expand(frames, 3))


def test_a_forearm_off_by_one_standard_deviation_in_depth_costs_about_a_half() -> None:
    """With the robust cost, 10 cm too near cost 0.5 / (1 + 1/9), and half of that at half the trust. Displacements
    across the view cost nothing."""
    x, jacobian = torch.zeros(1, 25, 3, dtype=torch.float64), torch.zeros(1, 25, 3, 9, dtype=torch.float64)
    depths = along_y(1)
    for axis, cost in ((0, 0.0), (1, 0.45), (2, 0.0)):
        moved = x.clone()
        moved[0, 4, axis] = -0.1
        assert depths.add(NormalEquations(1, 9, 9), moved, jacobian, jacobian) == pytest.approx(cost)
    depths.depth_m[0, LIMBS.index((3, 4))] = -0.1
    moved[0, 4] = torch.tensor([0, -0.1, 0])
    assert depths.add(NormalEquations(1, 9, 9), moved, jacobian, jacobian) == pytest.approx(0)
    depths.trust[:] = 0.5
    assert depths.add(NormalEquations(1, 9, 9), x, jacobian, jacobian) == pytest.approx(0.225)


def test_the_gradient_of_limb_depths_matches_their_cost() -> None:
    rig = two_bone_rig()
    articulation, pose, depths = Articulation(rig), random_pose(rig, 2), along_y(2)
    depths.depth_m[:] = 0.2

    def add(equations: NormalEquations, at: Pose) -> float:
        x, by_frame, by_shape = articulation.jacobian(articulation.keypoints(), articulation.pose(at))
        return depths.add(equations, 0.3 * x, 0.3 * by_frame, 0.3 * by_shape)

    check_gradient(pose, add, rtol=1e-5, least=1e-3)


def test_limb_depths_come_from_the_subjects_landmarks(tmp_path: Path) -> None:
    """Of two people, the second is the subject, whose right wrist is 0.3 m nearer than the elbow. The trust is that of
    the less certain end. In the second frame only a stranger is seen."""
    body, camera = moving_body((0, 1)), ring_camera("1", 0.4)
    capture = record(tmp_path, body, {"1": camera}, ("1",))
    observations = observe(capture)
    assert observe_limb_depths(capture, observations) is None
    pixels, metres = np.zeros((2, 2, 33, 3)), np.zeros((2, 2, 33, 3))
    pixels[:, 0] = 5, 5, 0.9
    from_body = {2: 12, 3: 14, 4: 16, 5: 11, 6: 13, 7: 15, 9: 24, 10: 26, 11: 28, 12: 23, 13: 25, 14: 27}
    for own, place in from_body.items():
        pixels[0, 1, place, :2] = observations.pixels[0, 0, own]
        pixels[0, 1, place, 2] = 0.8
    pixels[0, 1, 16, 2], metres[0, 1, 16, 2] = 0.6, -0.3
    (tmp_path / LANDMARKS).mkdir()
    np.savez(tmp_path / LANDMARKS / "1.npz", points_px=pixels, points_m=metres)
    depths = observe_limb_depths(capture, observations)
    assert depths is not None
    assert float(depths.depth_m[0, LIMBS.index((3, 4))]) == pytest.approx(-0.3)
    assert float(depths.trust[0, LIMBS.index((3, 4))]) == pytest.approx(0.6)
    assert float(depths.trust[0, LIMBS.index((12, 13))]) == pytest.approx(0.8) and not depths.trust[1].any()
    hips = body.vertices_m()[0].numpy().mean(0) - camera.centre_m
    assert float(depths.away[0] @ torch.from_numpy(hips / np.linalg.norm(hips)).double()) > 0.98


def test_the_view_direction_uses_only_visible_keypoints(tmp_path: Path) -> None:
    """Both shoulders are visible. The detector puts the other keypoints, which are not, at pixel (0, 0)."""
    body, camera = moving_body((0,)), ring_camera("1", 0.4)
    capture = record(tmp_path, body, {"1": camera}, ("1",))
    observations = observe(capture)
    hidden = [k for k in range(25) if k not in (2, 5)]
    observations.confidence[..., hidden], observations.pixels[..., hidden, :] = 0, 0
    (tmp_path / LANDMARKS).mkdir()
    nobody = np.zeros((1, 1, 33, 3))
    np.savez(tmp_path / LANDMARKS / "1.npz", points_px=nobody, points_m=nobody)
    depths = observe_limb_depths(capture, observations)
    assert depths is not None
    middle_px = observations.pixels[0, 0, [2, 5]].mean(0).numpy()
    np.testing.assert_allclose(depths.away[0], camera.rays(middle_px)[1], rtol=1e-6)


def test_several_cameras_see_depth_themselves(tmp_path: Path) -> None:
    cameras = {name: ring_camera(name, angle) for name, angle in (("1", 0.4), ("2", 2.0))}
    capture = record(tmp_path, moving_body((0,)), cameras, tuple(cameras))
    (tmp_path / LANDMARKS).mkdir()
    for name in cameras:
        np.savez(
            tmp_path / LANDMARKS / f"{name}.npz", points_px=np.zeros((1, 1, 33, 3)), points_m=np.zeros((1, 1, 33, 3))
        )
    assert observe_limb_depths(capture, observe(capture)) is None

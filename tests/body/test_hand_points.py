import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from hnerf.body.anny import anny_rig
from hnerf.body.articulation import Articulation, Pose
from hnerf.body.hand_points import PalmTerm, hand_points, has_fingers, moved_onto_palm, observe_hands
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.reprojection import Views, project
from tests.body.recorded_body import ring_camera
from tests.body.test_articulation import check_gradient, random_pose
from tests.body.two_bone import two_bone_rig

CAMERAS = tuple(ring_camera(str(k), angle) for k, angle in enumerate((0.3, 1.9)))


def body() -> Pose:
    pose = random_pose(anny_rig().to(dtype=torch.float64), 2)
    pose.root[:, :3, 3] = 0
    return pose


def points_of(pose: Pose) -> torch.Tensor:
    articulation = Articulation(pose.rig)
    return articulation.jacobian(hand_points(articulation), articulation.pose(pose))[0]


def views_of(x: torch.Tensor) -> Views:
    pixels = torch.stack([project(camera, x)[0] for camera in CAMERAS])
    return Views(CAMERAS, pixels, torch.ones(pixels.shape[:-1], dtype=torch.float64))


def test_hand_points_lie_at_joints_and_fingertips() -> None:
    pose = body()
    articulation = Articulation(pose.rig)
    joints = articulation.pose(pose)
    x, _, by_shape = articulation.jacobian(hand_points(articulation), joints)
    wrists = [articulation.joints.tolist().index(pose.rig.joint_names.index(f"wrist.{side}")) for side in "LR"]
    torch.testing.assert_close(x[:, [0, 21]], joints.positions_m[:, wrists])
    tip_m = (x[:, [4, 8, 12, 16, 20]] - x[:, [3, 7, 11, 15, 19]]).norm(dim=-1)
    assert (tip_m > 0.015).all() and (tip_m < 0.04).all()
    moved = pose.rig.beta + 0.1
    other = Pose(pose.rig.reshaped(moved), pose.theta, pose.root, pose.offsets_m)
    numeric = (points_of(other) - x) / 0.1
    torch.testing.assert_close(by_shape.sum(-1), numeric, atol=1e-8, rtol=0)
    assert has_fingers(pose.rig) and not has_fingers(two_bone_rig())


def test_the_points_of_a_palm_count_as_one_observation() -> None:
    """12 points are each off by 29.4 mm = sqrt(6) x 12 mm in both cameras, one standard deviation: 12 x 2 x 0.5 / (1 +
    (29.4 / 60)^2 = 1.24). Fingers off by any distance cost nothing."""
    pose = body()
    articulation = Articulation(pose.rig)
    joints = articulation.pose(pose)
    views = views_of(points_of(pose))
    views.pixels[..., 0] += 12 * math.sqrt(6)
    views.pixels[..., 6, 0] += 500
    equations = NormalEquations(2, articulation.unknowns, len(pose.rig.beta))
    cost = PalmTerm(views).add(equations, articulation, joints, torch.full((2, 2), 0.001))
    np.testing.assert_allclose(cost, 2 * 12 / 1.24)


def test_observations_of_hands_seen_by_one_camera_are_dropped() -> None:
    """Two of three cameras see the left hand, the second one with a single sure point; only the first one sees the
    right hand with confidence."""
    found = {"0": np.full((1, 2, 21, 3), 0.9), "1": np.full((1, 2, 21, 3), 0.4), "2": np.full((1, 2, 21, 3), 0.1)}
    found["1"][0, 0, 20, 2] = 0.6
    cameras = dict(zip("012", (*CAMERAS, CAMERAS[0]), strict=True))
    capture: Any = SimpleNamespace(train_cameras=("0", "1", "2"), cameras=cameras, hands=found.get)
    views = observe_hands(capture)
    assert views is not None and views.cameras == tuple(cameras.values())
    sure = [[0.9, 0.9, 0, 0], [0.4, 0.6, 0, 0], [0.1, 0.1, 0, 0]]
    assert views.confidence[:, 0, [0, 20, 21, 41]].tolist() == sure
    for names in (("0",), ("0", "3")):  # a single camera, and one without hand detection
        capture.train_cameras = names
        assert observe_hands(capture) is None


def test_moving_a_palm_weights_points_by_confidence() -> None:
    """Three of six points of the left palm are off by 9 px, with half the confidence of the others: (3 / 4 x 9) / (3 +
    3 / 4)."""
    x = points_of(body())
    seen = views_of(x)
    seen.pixels[0, :, [0, 1, 5], 0] -= 9
    seen.confidence[0, :, [0, 1, 5]] = 0.5
    moved = moved_onto_palm(seen, x).pixels - seen.pixels
    torch.testing.assert_close(moved[0, :, :21, 0], torch.full((2, 21), 1.8, dtype=torch.float64))


def test_hand_points_are_shifted_onto_the_bodys_palm() -> None:
    """In the second camera, the right hand is off by 5 px sideways and 3 px down. One of its knuckles is off by 12 px
    more, which shifts all points by 2 px."""
    x = points_of(body())
    seen = views_of(x)
    expected = seen.pixels.clone()
    expected[1, :, 21:, 0] -= 2
    expected[1, :, 21 + 17, 0] += 12
    seen.pixels[1, :, 21:] += torch.tensor([5.0, 3])
    seen.pixels[1, :, 21 + 17, 0] += 12
    torch.testing.assert_close(moved_onto_palm(seen, x).pixels, expected)


def test_the_gradient_of_the_palm_term_matches_its_cost() -> None:
    pose = body()
    articulation, views = Articulation(pose.rig), views_of(points_of(pose))
    views.pixels.add_(9 * torch.randn(views.pixels.shape, generator=torch.Generator().manual_seed(3)))
    scale_m = torch.full((2, 2), 0.002, dtype=torch.float64)

    def add(equations: NormalEquations, at: Pose) -> float:
        return PalmTerm(views).add(equations, articulation, articulation.pose(at), scale_m)

    check_gradient(pose, add, rtol=1e-5, least=1)

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import pose_vertices
from hnerf.errors import InputError
from hnerf.render.live import PROMPT_S, LivePerson, Pace, Shown, browser_camera, field_of_view_rad
from hnerf.render.motion import Motion
from tests.asset.figure import column_rig
from tests.body.two_bone import two_bone_rig

AHEAD = np.array([1.0, 0, 0, 0])
HALF = math.sqrt(0.5)


def person(body: BodyFit) -> LivePerson:
    return LivePerson(None, {"captured": Motion(body, 10.0, "z")})  # type: ignore[arg-type]


def bent_elbow(frames: tuple[int, ...] = (4,)) -> BodyFit:
    """Return the two-bone body with the elbow turned by 90 degrees about z in the first frame, less in later ones."""
    theta = torch.zeros(len(frames), 3, 3, dtype=torch.float64)
    theta[:, 1, 2] = torch.pi / 2 / torch.arange(1, 1 + len(frames))
    return BodyFit(two_bone_rig(), frames, theta, torch.eye(4, dtype=torch.float64).repeat(len(frames), 1, 1))


def test_a_browsers_camera_sees_the_middle_of_its_window() -> None:
    """From 4 m along -z, 90 degrees across the height: half the height is as many pixels as the focal length."""
    camera = browser_camera(AHEAD, np.array([0, 0, -4.0]), math.pi / 2, 2.0, 100)
    assert camera.size_px == (100, 50)
    seen_px, depth_m = camera.project(np.array([[0, 0, 0], [4.0, 0, 0], [0, 2.0, 0]]))
    np.testing.assert_allclose(seen_px, [[49.5, 24.5], [74.5, 24.5], [49.5, 37.0]])
    np.testing.assert_allclose(depth_m, 4)
    assert field_of_view_rad(camera) == pytest.approx(math.pi / 2)


def test_a_browsers_camera_turns_from_camera_to_world() -> None:
    """A quarter turn about the axis y, down in the image, takes what is ahead from z to x."""
    camera = browser_camera(np.array([HALF, 0, HALF, 0]), np.array([1.0, 2, 3]), 1.0, 0.5, 100)
    np.testing.assert_allclose(camera.forward, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(camera.centre_m, [1, 2, 3])
    assert camera.size_px == (50, 100)


def test_images_begin_at_the_largest_size_that_is_prompt() -> None:
    pace = Pace()
    assert pace.sides_px(500) == [96, 192, 384, 500]
    pace.took(96, PROMPT_S)
    pace.took(192, 1.01 * PROMPT_S)
    assert pace.sides_px(500) == [96, 192, 384, 500]
    pace.took(192, 0.5 * PROMPT_S)
    assert pace.sides_px(500) == [192, 384, 500]
    assert pace.sides_px(100) == [96, 100]
    assert pace.sides_px(50) == [50]


def test_a_joint_turns_about_its_own_axes_first() -> None:
    """The joint's y goes to z by the turn of 90 degrees about x, where the pose, about z, leaves it; the pose alone
    takes it to -x."""
    shown = person(bent_elbow()).body(Shown("captured", 4, {"elbow": (90.0, 0.0, 0.0)}))
    turned = Rotation.from_rotvec(shown.theta[0, 1].numpy()).apply([0, 1, 0])
    np.testing.assert_allclose(turned, [0, 0, 1], atol=1e-12)
    assert shown.frames == (4,)
    torch.testing.assert_close(bent_elbow().theta, person(bent_elbow()).body(Shown("captured", 4)).theta)


def test_each_frame_has_its_own_pose() -> None:
    shown = person(bent_elbow((4, 9))).body(Shown("captured", 9))
    torch.testing.assert_close(shown.theta[0, 1], torch.tensor([0, 0, torch.pi / 4]).double())


def test_another_shape_stands_where_the_captured_one_does() -> None:
    """The column, whose foot is 0.1 m above the ground, becomes half as wide again."""
    rig = column_rig()
    wider = torch.stack([rig.vertices_m * torch.tensor([1.0, 1, 0])])
    rig = dataclasses.replace(
        rig, beta=torch.zeros(1), beta_names=("weight",), shape_basis=wider, joint_basis=torch.zeros(1, 2, 3)
    )
    root = torch.eye(4)[None]
    body = BodyFit(rig, (0,), torch.zeros(1, 2, 3), root)
    shown = person(body).body(Shown("captured", 0, shape={"weight": 0.5}))
    expected = pose_vertices(rig, *body.pose(0)) * torch.tensor([1.5, 1.5, 1])
    torch.testing.assert_close(pose_vertices(shown.rig, *shown.pose(0)), expected)
    assert person(body).body(Shown("captured", 0, shape={"weight": 0.0})).rig is rig
    with pytest.raises(InputError, match="folds"):
        person(body).body(Shown("captured", 0, shape={"weight": -2.0}))

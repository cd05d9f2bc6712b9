"""The face of the rest body: changes worked out by hand, and a face found again that was moved."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from hnerf.body import face_fit
from hnerf.body.descriptor import normals_of
from hnerf.body.face_fit import (
    CHANGE_STD_M,
    POINT_STD_M,
    FaceView,
    _view,
    face_axes,
    fit_face,
    moved_face,
    photographs_of_face,
    solve_changes,
)
from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import vertex_skinning
from hnerf.capture.capture import Capture
from hnerf.detection.faces import POINTS, SIZE
from hnerf.geometry.camera import Camera
from hnerf.geometry.rays import cast, mesh_on_cpu
from hnerf.models import FACE_LANDMARKS, has_model
from tests.body.recorded_body import moving_body, record, ring_camera

AXES = np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0]])  # left, ahead, up
FRONT_AND_SIDE = np.stack([np.eye(3)[:2], np.eye(3)[[2, 1]]])  # what two views see of a change: x and y, z and y


def test_views_of_a_camera_count_as_one() -> None:
    """One camera says 4 mm in each of three views, another 1 mm: together 2.5 mm, less what the prior takes from two
    views of 2 mm each against 1 cm: 2 / (2 + 0.04). A change along z is seen by none."""
    seen_m = [0.004, 0.004, 0.004, 0.001]
    views = [face_view(camera, x_m, 0) for camera, x_m in zip("aaab", seen_m, strict=True)]
    rest_m, change_m = solve_changes(views, AXES)
    prior = POINT_STD_M**2 / CHANGE_STD_M[0] ** 2
    assert not rest_m.any() and rest_m.shape == (1, 3)
    np.testing.assert_allclose(change_m, [[0.0025 * 2 / (2 + prior), 0, 0]], rtol=0.02, atol=1e-12)


def test_depth_is_hardly_believed() -> None:
    """From the front a point has changed by (2, 3) mm, from the side by 5 mm ahead and again 3 mm up. A view of 2 mm
    against a prior of 1 mm ahead gives a fifth of 5 mm; against 1 cm, nearly all."""
    views = [face_view("a", 0.002, 0.003), face_view("b", 0.005, 0.003, side=1)]
    np.testing.assert_allclose(solve_changes(views, AXES)[1], [[0.002, 0.003, 0.001]], rtol=0.1)


def test_a_view_that_misses_a_point_does_not_take_trust_from_the_others() -> None:
    """One of two views of a camera misses the point: the other has all of the camera's weight."""
    views = [face_view("a", 0.004, 0), face_view("a", 0.5, 0)]
    views[1].rest_m[:] = np.nan
    prior = POINT_STD_M**2 / CHANGE_STD_M[0] ** 2
    np.testing.assert_allclose(solve_changes(views, AXES)[1][0, 0], 0.004 / (1 + prior), rtol=1e-2)


def test_an_outlier_and_a_missed_point_have_no_influence() -> None:
    views = [face_view("a", 0.002, 0), face_view("b", 0.002, 0), face_view("c", 0.5, 0), face_view("d", 0.05, 0)]
    views[3].rest_m[:] = np.nan
    np.testing.assert_allclose(solve_changes(views, AXES)[1][0, 0], 0.002, rtol=0.03)


def test_points_are_where_most_views_have_them() -> None:
    views = [face_view("a", 0, 0) for _ in range(3)]
    for view, x_m in zip(views, (0.1, 0.2, 0.9), strict=True):
        view.rest_m[0] = x_m
    np.testing.assert_allclose(solve_changes(views, AXES)[0], [[0.2, 0.2, 0.2]])


def test_the_face_of_a_standing_body_looks_along_minus_y() -> None:
    rig = moving_body((0,)).rig
    keypoints_m = (rig.keypoint_weights.double() @ rig.vertices_m.double()).numpy()
    middle_m, (left, ahead, up) = face_axes(keypoints_m)
    np.testing.assert_allclose(left, [1, 0, 0], atol=1e-3)
    assert ahead[1] < -0.9 and up[2] > 0.9 and abs(np.linalg.det([left, ahead, up])) == pytest.approx(1)
    eyes_m = keypoints_m[[15, 16]].mean(0)
    assert middle_m[1] > eyes_m[1] and middle_m[2] < eyes_m[2]  # behind and below the eyes
    turned = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(face_axes(keypoints_m @ turned.T)[1], [turned @ left, turned @ ahead, turned @ up])


def test_skin_follows_a_point_and_its_mirror_image() -> None:
    """A point at a vertex of the left cheek moves 4 mm to the left and 2 mm up. The vertex gives it a weight of 1, and
    1 stays, so it moves by half; the mirror image, 8 cm away, has no weight. The vertex opposite moves to the right.
    One standard deviation away, the weight is exp(-1/2)."""
    rig = moving_body((0,)).rig
    vertices_m = torch.tensor([[0.04, -0.1, 1.5], [-0.04, -0.1, 1.5], [0.04, -0.1, 1.515], [0.04, 0.5, 0.5]])
    rig = dataclasses.replace(rig, vertices_m=torch.cat([rig.vertices_m[:-4], vertices_m]))
    moved = moved_face(rig, np.array([[0.04, -0.1, 1.5]]), np.array([[0.004, 0, 0.002]]))
    moved_m = (moved.vertices_m - rig.vertices_m)[-4:].numpy()
    share = np.exp(-0.5) / (1 + np.exp(-0.5))
    np.testing.assert_allclose(moved_m[0], [0.002, 0, 0.001], atol=2e-5)
    np.testing.assert_allclose(moved_m[1], [-0.002, 0, 0.001], atol=2e-5)
    np.testing.assert_allclose(moved_m[2], [0.004 * share, 0, 0.002 * share], atol=2e-5)
    assert not moved_m[3].any()


def test_only_photographs_of_the_whole_face_are_looked_at(tmp_path: Path) -> None:
    """The body faces 0.6 rad left of -y, so at an angle of -0.97 rad; of four cameras a quarter turn apart, one is in
    front of it. With a fifth of the pixels, the region has fewer than 24."""
    body = moving_body((0, 1))
    cameras = {str(k): ring_camera(str(k), -0.97 + k * np.pi / 2) for k in range(4)}
    capture = record(tmp_path, body, cameras, ("0", "1", "2", "3"))
    assert [(photo.camera.name, photo.frame) for photo in photographs_of_face(capture, body)] == [
        ("0", 0),
        ("0", 1),
    ]
    both = cameras | {"4": ring_camera("4", -1.1)}
    seen = photographs_of_face(record(tmp_path, body, both, ("0", "4")), body)
    assert [(photo.camera.name, photo.frame) for photo in seen] == [("0", 0), ("0", 1), ("4", 0), ("4", 1)]
    behind = {"0": dataclasses.replace(cameras["0"], R=cameras["0"].R * [[-1], [1], [-1]])}
    behind["0"] = dataclasses.replace(behind["0"], t_m=-behind["0"].R @ cameras["0"].centre_m)
    assert photographs_of_face(dataclasses.replace(capture, cameras=cameras | behind), body) == []
    small = {name: camera.scaled(0.2) for name, camera in cameras.items()}
    assert photographs_of_face(dataclasses.replace(capture, cameras=small), body) == []


def test_a_view_compares_photograph_and_body(tmp_path: Path) -> None:
    """The network finds all points 2 crop pixels farther right in the photograph, which is black. In a region of 0.3 m,
    these are 0.3 x 2 / 192 m along its upper side. Derivatives are those of pixels, by differences, at the nearest
    vertices."""
    body = moving_body((0, 1))
    capture = record(tmp_path, body, {"0": ring_camera("0", -0.97)}, ("0",))
    photo = photographs_of_face(capture, body)[1]
    grid = np.stack(np.meshgrid(np.linspace(76, 116, 18), np.linspace(76, 116, 26)), -1).reshape(-1, 2)
    black = np.zeros((256, 256, 3), np.uint8)
    view = _view(black, photo, body, lambda crop: (grid + (0 if crop.any() else (2, 0)), 1.0))  # type: ignore[arg-type]
    assert view is not None and not np.isnan(view.rest_m).any()
    right = np.array([np.cos(photo.region.angle), np.sin(photo.region.angle)])
    np.testing.assert_allclose(view.seen_m, np.tile(0.3 * 2 / SIZE * right, (POINTS, 1)))
    transforms = vertex_skinning(body.rig, *body.pose(1)).double()
    for k in (0, 200, 467):
        rest_m = view.rest_m[k]
        nearest = int((body.rig.vertices_m - torch.from_numpy(rest_m)).norm(dim=-1).argmin())
        turn, shift = transforms[nearest, :, :3].numpy(), transforms[nearest, :, 3].numpy()
        ends_px = [photo.camera.project((rest_m + step) @ turn.T + shift)[0] for step in 1e-4 * np.eye(3)]
        by_rest = (np.array(ends_px) - photo.camera.project(rest_m @ turn.T + shift)[0]).T / 1e-4
        np.testing.assert_allclose(view.by_rest[k], by_rest * 0.3 / photo.region.side_px, atol=0.02)
    assert _view(black, photo, body, lambda crop: (grid, 0.5)) is None  # type: ignore[arg-type]
    wide = _view(black, photo, body, lambda crop: (grid + np.array([0, 75]), 1.0))  # type: ignore[arg-type]
    assert wide is not None  # the lowest points are on the shoulders, farther from the head's middle than its region
    assert np.isnan(wide.rest_m[-1]).all() and not np.isnan(wide.rest_m[0]).any()


def test_a_face_that_was_moved_is_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The photographs show a body whose eyes are 8 mm lower than those of the fit. Its eyes move down by more than half
    of that, and its chin by less than 2 mm."""
    if not has_model(FACE_LANDMARKS):
        pytest.skip("the networks are not installed; run `hnerf models`")
    body = moving_body((0, 1, 2))
    keypoints_m = (body.rig.keypoint_weights @ body.rig.vertices_m).double().numpy()
    truth = dataclasses.replace(
        body, rig=moved_face(body.rig, np.repeat(keypoints_m[[15, 16]], 20, 0), np.array([[0, 0, -0.008]] * 40))
    )
    cameras = {str(k): face_camera(body, str(k), angle) for k, angle in enumerate((-1.3, -0.6))}
    capture = record(tmp_path, body, cameras, ("0", "1"))
    monkeypatch.setattr(Capture, "image", lambda self, name, frame: photograph(truth, self.cameras[name], frame))
    found = fit_face(capture, body)
    moved_m = ((found.rig.keypoint_weights @ found.rig.vertices_m).double().numpy() - keypoints_m)[[15, 16]]
    assert (moved_m[:, 2] < -0.004).all() and np.abs(moved_m[:, :2]).max() < 0.002
    chin = (body.rig.vertices_m - torch.from_numpy(keypoints_m[0] - [0, 0, 0.07])).norm(dim=-1).argmin()
    assert (found.rig.vertices_m - body.rig.vertices_m)[chin].norm() < 0.002


def test_too_few_views_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One camera sees the face, in two frames or in three."""
    monkeypatch.setattr(face_fit, "FaceNetwork", lambda: None)
    monkeypatch.setattr(Capture, "image", lambda self, name, frame: None)
    monkeypatch.setattr(face_fit, "_view", lambda image, photo, fit, network: face_view(photo.camera.name, 0.01, 0))
    body = moving_body((0, 1))
    cameras = {str(k): ring_camera(str(k), -0.97 + k * np.pi / 2) for k in range(4)}
    assert fit_face(record(tmp_path, body, cameras, ("0", "1", "2", "3")), body) is body
    more = moving_body((0, 1, 2))
    assert fit_face(record(tmp_path, more, cameras, ("0", "1", "2", "3")), more) is not more


def face_view(camera: str, x_m: float, y_m: float, side: int = 0) -> FaceView:
    """Return a view that shows one point, at the origin, changed in its image by (x, y)."""
    rest_m, seen_m, by_rest = np.full((POINTS, 3), np.nan), np.zeros((POINTS, 2)), np.zeros((POINTS, 2, 3))
    rest_m[0], seen_m[0], by_rest[0] = 0, (x_m, y_m), FRONT_AND_SIDE[side]
    return FaceView(camera, rest_m, seen_m, by_rest)


def face_camera(body: BodyFit, name: str, angle: float) -> Camera:
    """Return a camera on a ring, moved up to the head, with a long lens."""
    camera = ring_camera(name, angle)
    height_m = float(body.vertices_m()[0, :, 2].max()) - 0.15
    t_m = -camera.R @ np.array([*camera.centre_m[:2], height_m])
    return dataclasses.replace(camera, t_m=t_m, K=np.array([[1100, 0, 128], [0, 1100, 128], [0, 0, 1.0]]))


def photograph(body: BodyFit, camera: Camera, frame: int) -> np.ndarray:
    """Render a body in brown on grey, lit from above left, (H, W, 3) uint8."""
    vertices_m, faces = body.vertices_m()[body.index(frame)].double().numpy(), body.rig.faces.numpy()
    hits = cast(mesh_on_cpu(vertices_m, faces), *camera.rays(camera.pixels_px.reshape(-1, 2)))
    lit = (hits.interpolate(normals_of(vertices_m, faces), faces) @ camera.R.T @ [-0.4, -0.6, -0.7]).clip(0, 1)
    picture = np.full((len(hits.face), 3), 127, np.uint8)
    picture[hits.face >= 0] = (0.4 + 0.6 * lit)[:, None] * (200, 150, 120)
    return picture.reshape(camera.height_px, camera.width_px, 3)


def test_a_head_that_the_border_cuts_in_half_is_not_looked_at(tmp_path: Path) -> None:
    body, camera = moving_body((0,)), ring_camera("0", -0.97)
    capture = record(tmp_path, body, {"0": camera}, ("0",))
    (photo,) = photographs_of_face(capture, body)
    at_border = dataclasses.replace(camera, K=camera.K - np.outer([0, photo.region.centre_px[1], 0], [0, 0, 1]))
    assert photographs_of_face(dataclasses.replace(capture, cameras={"0": at_border}), body) == []

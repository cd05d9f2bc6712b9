import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from hnerf.avatar import surface
from hnerf.avatar.avatar import Avatar, Rendering
from hnerf.capture.footage import Video
from hnerf.geometry.camera import Camera
from hnerf.render import pictures
from hnerf.render.pictures import (
    depth_image,
    depth_span_mm,
    frame_times,
    normal_image,
    read_depth_grey,
    write_pictures,
    write_video,
)
from tests.evaluation.ball import RADIUS_M, RENDERED, SIZE_PX, BallAvatar, ball_camera, ball_fit, ball_mask, centre_m

CAMERA = ball_camera("a", 0.0)  # 0.75 m from the ball, on the x axis


class SolidBall(BallAvatar):
    """The ball, rendered with depths; in frame 0 it is 0.65 m from the camera."""

    def render(self, camera: Camera, theta: Tensor, root: Tensor) -> Rendering:
        origins, directions = camera.rays(camera.pixels_px)
        towards = root[:3, 3].numpy() - origins
        middle = (towards * directions).sum(-1)
        inside = RADIUS_M**2 - (towards**2).sum(-1) + middle**2
        depth = np.where(inside > 0, middle - np.sqrt(inside.clip(0)), 0)
        alpha = torch.from_numpy(inside > 0).float()
        return Rendering(alpha[..., None].expand(-1, -1, 3) * RENDERED / 255, alpha, torch.from_numpy(depth).float())


def test_depth_is_measured_along_the_viewing_axis() -> None:
    oblique = 1 / (CAMERA.rays(CAMERA.pixels_px)[1] @ CAMERA.forward)  # a wall 2 m ahead is further along slanting rays
    alpha = torch.ones(SIZE_PX, SIZE_PX)
    alpha[0, 0] = 0.4
    depth = depth_image(Rendering(torch.zeros(SIZE_PX, SIZE_PX, 3), alpha, torch.from_numpy(2 * oblique)), CAMERA)
    assert depth.dtype == torch.uint16
    assert depth[0, 0] == 0
    assert set(depth.flatten()[1:].tolist()) == {2000}


def test_normals_of_a_ball_point_away_from_its_middle() -> None:
    ball = SolidBall(ball_fit())
    theta, root = ball.body.theta[0], ball.body.root[0]
    rendering = ball.render(CAMERA, theta, root)
    image = normal_image(ball, rendering, CAMERA, theta, root).numpy()
    rays = CAMERA.rays(np.array([[40.0, 28]]))  # right of the middle, and above it
    point_m = rays[0] + rays[1] * rendering.depth_m[28, 40].item()
    x, y, z = CAMERA.R @ ((point_m[0] - centre_m(0)) / RADIUS_M)
    np.testing.assert_allclose(image[28, 40], 127.5 * (np.array([x, -y, -z]) + 1), atol=2)
    assert (image[28, 40] > 127).all()
    assert (image[~ball_mask(CAMERA, centre_m(0))] == 0).all()


def test_a_pixel_whose_centre_misses_the_person_has_no_depth_or_normal() -> None:
    """Three of its quarters are covered, so its alpha is .75; the depth is that of its centre, so it has none."""
    ball = SolidBall(ball_fit())
    alpha, depth_m = torch.zeros(SIZE_PX, SIZE_PX), torch.zeros(SIZE_PX, SIZE_PX)
    alpha[28, 40] = 0.75
    rendering = Rendering(torch.zeros(SIZE_PX, SIZE_PX, 3), alpha, depth_m)
    assert not depth_image(rendering, CAMERA).any()
    assert not normal_image(ball, rendering, CAMERA, ball.body.theta[0], ball.body.root[0]).any()


def test_every_kind_of_image_and_mesh_is_written_for_every_shot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hnerf.avatar.surface.POSED_CELLS", 48)
    ball = SolidBall(ball_fit())
    shots = [(CAMERA, 0), (ball_camera("b", 90.0), 3)]
    write_pictures(ball, shots, ("colour", "depth", "normals", "mask", "mesh"), 5.0, tmp_path)
    for number, (camera, frame) in enumerate(shots):
        images = {
            kind: cv2.imread(str(tmp_path / kind / f"{number:06d}.png"), cv2.IMREAD_UNCHANGED)
            for kind in ("colour", "depth", "normals", "mask")
        }
        mask = ball_mask(camera, centre_m(frame))
        np.testing.assert_array_equal(images["colour"], np.where(mask, RENDERED, 0)[..., None].repeat(3, -1))
        np.testing.assert_array_equal(images["mask"], np.where(mask, 255, 0))
        assert images["depth"].dtype == np.uint16
        np.testing.assert_array_equal(images["depth"] > 0, mask)
        assert images["normals"][mask][:, 0].min() > 127  # blue, which cv2 reads first: towards the camera
        mesh = trimesh.load_mesh(tmp_path / "mesh" / f"{number:06d}.ply")
        np.testing.assert_allclose(mesh.bounds.mean(0), centre_m(frame), atol=1e-3)
        np.testing.assert_allclose(mesh.extents, 2 * RADIUS_M, atol=2e-3)
    depth = cv2.imread(str(tmp_path / "depth" / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert depth[31, 31] == pytest.approx(650, abs=1)


def test_the_surface_of_a_frame_is_extracted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hnerf.avatar.surface.POSED_CELLS", 24)
    extracted = []

    def posed_surface(avatar: Avatar, frame: int) -> trimesh.Trimesh:
        extracted.append(frame)
        return surface.posed_surface(avatar, frame)

    monkeypatch.setattr(pictures, "posed_surface", posed_surface)
    shots = [(CAMERA, 3), (CAMERA, 0), (ball_camera("b", 90.0), 3), (ball_camera("b", 90.0), 0)]
    write_pictures(SolidBall(ball_fit()), shots, ("mesh",), 5.0, tmp_path)
    assert extracted == [3, 0]
    written = [(tmp_path / "mesh" / f"{number:06d}.ply").read_bytes() for number in range(4)]
    assert written[2:] == written[:2] and written[0] != written[1]


def test_every_kind_of_image_is_also_written_as_a_video(tmp_path: Path) -> None:
    write_pictures(SolidBall(ball_fit()), [(CAMERA, 0)] * 2, ("colour", "depth", "normals", "mask"), 5.0, tmp_path)
    towards_camera = (127.5, 127.5, 255)
    for kind, middle in {"colour": RENDERED, "depth": 255, "normals": towards_camera, "mask": 255}.items():
        video = Video.open(tmp_path / f"{kind}.mp4")
        assert (len(video.frames), video.fps) == (2, 5.0)
        for frame in (0, 1):
            (picture,) = video.read([frame])
            np.testing.assert_allclose(picture.rgb[31, 31], middle, atol=16, err_msg=kind)
            assert picture.rgb[0, 0].max() < 16  # background


def test_a_video_in_a_folder_with_a_colon_is_no_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "take:1"
    folder.mkdir()
    cv2.imwrite(str(folder / "000000.png"), np.zeros((16, 16, 3), np.uint8))
    monkeypatch.chdir(tmp_path)
    write_video(Path("take:1"), 5.0, [1], Path("take:1") / "colour.mp4")
    assert next(Video.open(Path("take:1") / "colour.mp4").read([0])).rgb.shape == (16, 16, 3)


@pytest.mark.parametrize("fps", [200 / 3, 29.97, 1000 / 3, 30 / 36_000])
def test_a_video_has_the_frame_rate_as_exactly_as_the_format_allows(fps: float, tmp_path: Path) -> None:
    (tmp_path / "colour").mkdir()
    for number in range(2):
        cv2.imwrite(str(tmp_path / "colour" / f"{number:06d}.png"), np.zeros((16, 16, 3), np.uint8))
    write_video(tmp_path / "colour", fps, [1, 1], tmp_path / "colour.mp4")
    assert Video.open(tmp_path / "colour.mp4").fps == pytest.approx(max(fps, 0.01), rel=1e-3)


@pytest.mark.parametrize(
    ("frames", "rate", "lasts"),
    [
        ([4], 30.0, [1]),
        ([4, 4, 4], 30.0, [1, 1, 1]),
        ([0, 6, 12, 0, 6], 5.0, [1, 1, 1, 1, 1]),  # played again
        ([0, 4, 8, 14, 16], 15.0, [2, 2, 3, 1, 1]),
        ([0, 2, 4, 6, 5000, 5002], 15.0, [1, 1, 1, 2, 1, 1]),  # two recordings
    ],
)
def test_times_of_frames_by_hand(frames: list[int], rate: float, lasts: list[int]) -> None:
    assert frame_times(frames, 30.0) == (rate, lasts)


def test_grey_levels_of_depths_by_hand(tmp_path: Path) -> None:
    depths_mm = np.array([[[0, 2000], [2100, 2200]], [[0, 0], [2400, 0]], [[0, 0], [0, 0]]], np.uint16)
    for k, depth_mm in enumerate(depths_mm):
        cv2.imwrite(str(tmp_path / f"{k}.png"), depth_mm)
    assert depth_span_mm(tmp_path) == (2000, 2400)
    first, second, third = (read_depth_grey(tmp_path / f"{k}.png", (2000, 2400)) for k in range(3))
    # 255 to 64 in 400 mm: 100 mm are 47.75
    np.testing.assert_array_equal(first[..., 0], [[0, 255], [207, 160]])
    np.testing.assert_array_equal(second[..., 2], [[0, 0], [64, 0]])
    assert third.shape == (2, 2, 3) and not third.any()


def test_depth_images_without_a_person_are_black(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((16, 16), np.uint16))
    assert not read_depth_grey(tmp_path / "0.png", depth_span_mm(tmp_path)).any()


def test_only_the_requested_kinds_are_written(tmp_path: Path) -> None:
    write_pictures(SolidBall(ball_fit()), [(CAMERA, 0)], ("mask",), 5.0, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mask", "mask.mp4"]


def test_a_video_that_lost_frames_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.zeros((16, 16, 3), np.uint8))
    whole = Video.open
    monkeypatch.setattr(pictures.Video, "open", lambda path: Video(path, (0, 1), 5.0))
    with pytest.raises(OSError, match="2 of 3 frames"):
        write_video(tmp_path, 5.0, [1, 1, 1], tmp_path / "colour.mp4")

    def cut_short(path: Path) -> Video:
        os.truncate(path, path.stat().st_size // 2)
        return whole(path)

    monkeypatch.setattr(pictures.Video, "open", cut_short)
    with pytest.raises(OSError, match="0 of 3 frames"):
        write_video(tmp_path, 5.0, [1, 1, 1], tmp_path / "colour.mp4")

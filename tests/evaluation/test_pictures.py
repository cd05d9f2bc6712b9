import numpy as np
import pytest
import trimesh

from hnerf.evaluation import pictures
from hnerf.geometry.mesh_queries import Surface
from tests.evaluation.ball import ball_camera


def test_a_cropped_camera_matches_its_crop() -> None:
    camera = ball_camera("a", 30.0)
    box = (slice(10, 50), slice(20, 50))  # 40 x 30 px become 400 x 300
    cropped = pictures.cropped_camera(camera, box)
    assert cropped.size_px == pictures.PICTURE_PX
    point_m = np.array([0.02, -0.03, 1.05])
    (x, y), (u, v) = camera.project(point_m)[0], cropped.project(point_m)[0]
    assert (u, v) == pytest.approx(((x - 20 + 0.5) * 10 - 0.5, (y - 10 + 0.5) * 10 - 0.5))  # pixel centres at integers


def test_a_person_is_framed_with_the_aspect_ratio_of_the_report() -> None:
    person = np.zeros((200, 300), bool)
    person[60:121, 100:111] = True
    # padded by 20 px: rows 40 to 140, columns 80 to 130; 101 rows need 75 columns, centred on these
    assert pictures.frame_person(person) == (slice(40, 141), slice(68, 143))
    assert pictures.frame_person(np.zeros((40, 30), bool)) == (slice(0, 40), slice(0, 30))


def test_the_error_map_goes_from_dark_to_bright_and_saturates() -> None:
    reference = np.zeros((1, 3, 3), np.uint8)
    rendered = np.array([[[0] * 3, [64] * 3, [255] * 3]], np.uint8)
    none, quarter, full = pictures.error_map(rendered, reference)[0].astype(int)
    assert none.sum() < 10
    assert np.array_equal(quarter, full) and full.sum() > 600


def test_portraits_show_the_front_and_the_back() -> None:
    front_m, back_m = np.array([0.3, -0.2, 0.0]), np.array([-0.3, 0.2, 1.0])  # facing -Y, Z up
    points_m = np.stack([front_m, back_m])
    for ahead, nearer, further in (([0.0, 1, 0], front_m, back_m), ([0.0, -1, 0], back_m, front_m)):
        camera = pictures.portrait_camera(points_m, np.array(ahead), np.array([0.0, 0, 1]))
        (_, low_px), (_, high_px) = (camera.project(p)[0] for p in points_m)
        assert camera.project(nearer)[1] < camera.project(further)[1]
        assert 0 < high_px < 40 and 360 < low_px < 400  # head up, filling 94 % of 400 px


def test_the_distance_map_shows_the_distance_to_the_truth() -> None:
    ball = trimesh.creation.icosphere(3, 0.3)
    camera = pictures.portrait_camera(ball.vertices, np.array([0.0, 1, 0]), np.array([0.0, 0, 1]))
    surface, far = Surface(ball), Surface(trimesh.creation.icosphere(3, 0.3 + pictures.FULL_DISTANCE_M))
    shot = pictures.shoot(surface, camera)
    same, off = (pictures.distance_map(shot, truth)[200, 150].astype(float) for truth in (surface, far))
    assert same / same[0] == pytest.approx(pictures.DISTANCE_COLOURS[0] / pictures.DISTANCE_COLOURS[0][0], abs=0.02)
    assert off / off[0] == pytest.approx(pictures.DISTANCE_COLOURS[-1] / pictures.DISTANCE_COLOURS[-1][0], abs=0.05)
    assert np.array_equal(pictures.clay(shot)[0, 0], [255, 255, 255])

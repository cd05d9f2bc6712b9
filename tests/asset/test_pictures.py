import base64
import dataclasses
import io

import numpy as np
import pytest
from PIL import Image

from hnerf.asset import pictures
from hnerf.asset.levels import Level
from hnerf.asset.staging import StagedAvatar
from hnerf.asset.texture import UvLayout
from hnerf.evaluation.pictures import shoot, shrunk
from hnerf.geometry.mesh_queries import Surface

RED, GREEN, BLUE = [255, 0, 0], [0, 255, 0], [0, 0, 255]
FRONT = np.array([0.0, 0.2, 1.0])  # tilted back


@pytest.fixture
def card(staged: StagedAvatar) -> StagedAvatar:
    """Return a square card of two faces, 1 m wide and facing +Z, with a texture of two by two colours."""
    corners_m = np.array([[-0.5, 0, 0], [0.5, 0, 0], [0.5, 1, 0], [-0.5, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    texture = np.array([[RED, GREEN], [BLUE, [255, 255, 0]]], np.uint8).repeat(32, 0).repeat(32, 1)
    uvs = corners_m[:, :2] + (0.5, 0)
    levels = [Level(np.arange(4), faces, UvLayout(uvs, faces))]
    return dataclasses.replace(staged, levels=levels, texture=texture, points_m=corners_m[None].astype(np.float32))


def surface_of(card: StagedAvatar) -> Surface:
    return Surface.of(card.points_m[0], card.faces)


def test_the_texture_is_seen_upright_from_the_front(card: StagedAvatar) -> None:
    front = pictures.turntable_cameras(card.points_m[0], FRONT, 4)[0]
    picture = pictures.textured(shoot(surface_of(card), front), card)
    # the image has 300 x 400 px; the card is 282 px wide and high, in the middle
    assert picture[100, 60].tolist() == RED
    assert picture[100, 240].tolist() == GREEN
    assert picture[300, 60].tolist() == BLUE
    assert picture[20, 150].tolist() == [255, 255, 255]


def test_the_turntable_goes_around_the_person(card: StagedAvatar) -> None:
    cameras = pictures.turntable_cameras(card.points_m[0], FRONT, 4)
    directions = [camera.forward.round(6).tolist() for camera in cameras]
    assert directions == [[0, 0, -1], [-1, 0, 0], [0, 0, 1], [1, 0, 0]]
    assert all(camera.R[1].round(6).tolist() == [0, -1, 0] for camera in cameras)  # image down is -Y


def test_the_wireframe_draws_edges_over_grey_faces(card: StagedAvatar) -> None:
    front = pictures.turntable_cameras(card.points_m[0], FRONT, 4)[0]
    picture = pictures.wireframe(shoot(surface_of(card), front)).astype(int)
    diagonal, inside = picture[199, 150], picture[150, 100]
    assert inside.max() - inside.min() < 15  # grey
    assert diagonal[2] - diagonal[0] > 40  # blue
    assert np.array_equal(picture[10, 10], [255, 255, 255])


def test_the_layout_shows_where_faces_lie_in_the_texture(card: StagedAvatar) -> None:
    level = Level(np.arange(4), card.faces, UvLayout(card.uvs * (1, 0.5), card.face_uvs))
    lower = dataclasses.replace(card, levels=[level])
    layout = pictures.uv_picture(lower, 64)
    assert layout[10, 32].tolist() == [255, 255, 255]
    assert layout[60, 40].tolist() == pictures.PAPER.tolist()
    assert shrunk(card.texture, 32)[4, 4].tolist() == RED


def test_joints_are_drawn_over_the_picture_with_lines_to_their_parents(card: StagedAvatar) -> None:
    """The root has no line: from the front, it is 282 px below the joint above it."""
    front = pictures.turntable_cameras(card.points_m[0], FRONT, 4)[0]
    grey = np.full((400, 300, 3), 200, np.uint8)
    positions_m = np.array([[0.0, 0, 0], [0, 1, 0], [0.5, 1, 0]])
    drawn = pictures.joints_over(grey, front, positions_m, np.array([-1, 0, 1]))
    for point_m in positions_m:
        column, row = front.project(point_m)[0].round().astype(int)
        assert drawn[row, column].tolist() == pictures.ACCENT.tolist()
    row = round(float(front.project(positions_m[1])[0][1]))
    assert drawn[row, 220, 2] > drawn[row, 220, 0] + 40  # blue
    assert drawn[200, 150].tolist() == [200, 200, 200]
    assert np.array_equal(grey, np.full_like(grey, 200))


def test_the_moving_picture_shows_its_views_in_turn_without_an_end() -> None:
    views = [np.full((40, 30, 3), colour, np.uint8) for colour in (RED, GREEN, BLUE)]
    uri = pictures.moving_uri(views, 160)
    assert uri.startswith("data:image/webp;base64,")
    with Image.open(io.BytesIO(base64.b64decode(uri.split(",")[1]))) as moving:
        assert moving.info["loop"] == 0  # for ever
        for k, view in enumerate(views):
            moving.seek(k)
            shown = np.asarray(moving.convert("RGB")).astype(int)
            assert moving.info["duration"] == 160
            assert np.abs(shown - view).max() < 12

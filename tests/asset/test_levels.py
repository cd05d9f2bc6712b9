import dataclasses
import itertools

import numpy as np
import pytest
import trimesh

from hnerf.asset.figures import level_figures
from hnerf.asset.levels import Level, levels_of, seam_edges
from hnerf.asset.staging import StagedAvatar
from hnerf.asset.texture import UvLayout, unwrap
from tests.asset.figure import upright_column


def test_a_cube_is_simplified_to_its_corners() -> None:
    """A cube of 2 m whose twelve triangles are each cut into four, unwrapped into one chart without an outline."""
    cube = trimesh.creation.box((2, 2, 2)).subdivide()
    unused = np.zeros((1, 2), np.float32)
    layout = UvLayout(np.concatenate([unused, cube.vertices[:, :2].astype(np.float32)]), 1 + np.array(cube.faces))
    levels = levels_of(cube.vertices, cube.faces, layout, [12, 48, 16], {})
    assert [len(level.faces) for level in levels] == [48, 16, 12]
    np.testing.assert_array_equal(levels[0].vertices, range(26))
    corners = levels[2]
    kept_m = cube.vertices[corners.vertices]
    assert sorted(map(tuple, kept_m.tolist())) == sorted(itertools.product((-1, 1), repeat=3))
    assert trimesh.Trimesh(kept_m, corners.faces, process=False).volume == pytest.approx(8)
    np.testing.assert_array_equal(corners.layout.uvs[corners.layout.face_uvs], kept_m[corners.faces][..., :2])


def signed_area(level: Level) -> float:
    """Return the area of the faces in the texture; mirrored faces count as negative."""
    a, b, c = level.layout.uvs[level.layout.face_uvs].swapaxes(0, 1)
    return float((((b - a)[:, 0] * (c - a)[:, 1]) - ((b - a)[:, 1] * (c - a)[:, 0])).sum() / 2)


def places(level: Level) -> set[tuple[float, ...]]:
    """Return the vertex and the texture coordinates of each face corner."""
    uvs = level.layout.uvs[level.layout.face_uvs].reshape(-1, 2)
    return {tuple(row) for row in np.column_stack([level.vertices[level.faces].ravel(), uvs]).tolist()}


def test_levels_of_detail_keep_all_seams_of_the_charts(caplog: pytest.LogCaptureFixture) -> None:
    """A closed column whose charts have seams with 224 edges in all, so no level can have fewer than 336 faces."""
    column = upright_column(0.18, -0.05, 1.65)
    layout = unwrap(column.vertices, column.faces, 64)
    whole, coarse = levels_of(column.vertices, column.faces, layout, [5000, 400, 335], {})
    assert (len(whole.faces), len(coarse.faces)) == (816, 400)
    mesh = trimesh.Trimesh(column.vertices[coarse.vertices], coarse.faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(column.volume)
    assert places(coarse) < places(whole)
    seams = [level.layout.uvs[seam_edges(level.layout.face_uvs)] for level in (whole, coarse)]
    before, after = ({frozenset(map(tuple, edge)) for edge in edges.tolist()} for edges in seams)
    assert before == after and len(before) == 224
    assert signed_area(coarse) == pytest.approx(signed_area(whole))
    assert "level of detail of 335 triangles left out: the texture's seams alone have 224 edges" in caplog.text


def test_the_distance_of_a_level_is_averaged_over_points_of_both_meshes(staged: StagedAvatar) -> None:
    """A roof of two slopes of 45 degrees with its ridge at x = 1, and the floor below it. From x on the floor, the
    nearest slope is x / sqrt 2 away; from x on a slope, the floor is x away: (1 / sqrt 2 + 1) / 4 on average over
    both."""
    points_m = np.array([[0.0, 0, 0], [0, 9, 0], [1, 0, 1], [1, 9, 1], [2, 0, 0], [2, 9, 0]])
    roof, floor = np.array([[0, 2, 3], [0, 3, 1], [2, 4, 5], [2, 5, 3]]), np.array([[0, 2, 3], [0, 3, 1]])
    layout = UvLayout(np.zeros((6, 2), np.float32), roof)
    levels = [Level(np.arange(6), roof, layout), Level(np.array([0, 1, 4, 5]), floor, layout)]
    figures = level_figures(dataclasses.replace(staged, rest_points_m=points_m, levels=levels))
    assert figures["lod0"] == {"vertices": 6, "triangles": 4}
    assert (figures["lod1"]["vertices"], figures["lod1"]["triangles"]) == (4, 2)
    assert figures["lod1"]["to_lod0_mean_mm"] == pytest.approx(250 / np.sqrt(2) + 250, rel=0.02)
    assert figures["lod1"]["to_lod0_p99_mm"] == pytest.approx(980, rel=0.01)  # 2 % of the slopes lie above 0.98 m


def test_faces_that_expressions_move_are_decimated_least() -> None:
    """A ball in 1280 triangles, in one chart. An expression moves one half of it by 3 mm and the other by 1 mm: the
    first keeps more than twice as many vertices. If an expression moves all vertices, they are decimated alike."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    right = ball.vertices[:, 0] > 0
    layout = UvLayout(ball.vertices[:, :2].astype(np.float32), np.array(ball.faces))
    moved_m = np.where(right, 0.003, 0.001)[:, None] * [0.0, 0, 1]

    def kept(expressions_m: dict[str, np.ndarray]) -> tuple[int, int]:
        level = levels_of(ball.vertices, ball.faces, layout, [300], expressions_m)[1]
        return right[level.vertices].sum(), (~right)[level.vertices].sum()

    here, there = kept({"smile": moved_m})
    assert here > 2 * there
    assert kept({"smile": moved_m + 0.01}) == kept({})


def test_what_any_expression_moves_is_decimated_least() -> None:
    """As above, with a second expression that moves nothing by more than 1 mm."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    right = ball.vertices[:, 0] > 0
    layout = UvLayout(ball.vertices[:, :2].astype(np.float32), np.array(ball.faces))
    moved_m = np.where(right, 0.003, 0.001)[:, None] * [0.0, 0, 1]
    vertices = levels_of(ball.vertices, ball.faces, layout, [300], {"smile": moved_m, "blink": moved_m / 3})[1].vertices
    assert right[vertices].sum() > 2 * (~right)[vertices].sum()

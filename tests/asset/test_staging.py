import dataclasses
import tracemalloc
from typing import Any

import numpy as np
import pytest
import torch

from hnerf.asset import rigs, staging
from hnerf.asset.correctives import correctives_of
from hnerf.asset.levels import Level
from hnerf.asset.motions import Motion
from hnerf.asset.rigs import RestSurface, StagedRig, stage_rigs
from hnerf.asset.skinning import Skin
from hnerf.asset.staging import StagedAvatar, moved_points, stage_avatar
from hnerf.asset.texture import UvLayout
from hnerf.body.fit_result import BodyFit
from hnerf.geometry.axes import y_up_from
from hnerf.progress import Progress, listening
from tests.asset.figure import FRAMES, bending_body, column_rig

LAYOUT = UvLayout(np.zeros((1, 2), np.float32), np.zeros((1, 3), np.int64))
TEXTURE = np.zeros((4, 4, 3), np.uint8)


def staged_without_shapes(clothed: BodyFit, up: str = "z") -> StagedAvatar:
    """Return a body staged as skinned, without correctives, at 10 frames a second."""
    none = correctives_of(np.zeros((len(clothed.frames), len(clothed.rig.vertices_m), 3), np.float32), 0)
    return stage_avatar(clothed, clothed.vertices_m().numpy(), none, LAYOUT, TEXTURE, up, 10.0, "identity")


def test_z_up_becomes_y_up() -> None:
    np.testing.assert_array_equal(y_up_from("z") @ [1, 2, 3], [1, 3, -2])
    np.testing.assert_array_equal(y_up_from("y") @ [1, 2, 3], [1, 2, 3])


def test_staged_joints_by_hand() -> None:
    """The body stands at (1, 2, 3) in the world; its upper joint bends by 90 degrees about the body's x."""
    theta = torch.tensor([[[0.0, 0, 0], [torch.pi / 2, 0, 0]]])
    root = torch.eye(4)[None].clone()
    root[0, :3, 3] = torch.tensor([1.0, 2, 3])
    staged = staged_without_shapes(BodyFit(column_rig(), (7,), theta, root))
    full = staged.rigs["full"]
    assert full.skeleton.names == ("root", "pelvis", "upper_L")
    np.testing.assert_allclose(full.skeleton.positions_m, [[0, 0, 0], [0, 0, 0], [0, 0.8, 0]], atol=1e-7)
    motion = full.motions["captured"]
    # The root lies below the pelvis on the floor, at the height of the lowest point: z = 3, stage y = 3.
    np.testing.assert_allclose(motion.translations_m[0], [[1, 3, -2], [0, 0, 0], [0, 0.8, 0]], atol=1e-6)
    np.testing.assert_allclose(motion.quaternions[0, :2], [[0, 0, 0, 1]] * 2, atol=1e-7)
    # World and stage share the x axis, so the bend stays a quarter turn about +x.
    np.testing.assert_allclose(motion.quaternions[0, 2], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-6)
    # The column's top centre (0, 0, 1.6) swings to (0, -0.8, 0.8) in the body: (1, 1.2, 3.8) in the world.
    top = staged.points_m[0][np.argmin(np.linalg.norm(staged.rest_points_m - [0, 1.6, 0], axis=1))]
    np.testing.assert_allclose(top, [1, 3.8, -1.2], atol=1e-5)


def test_the_soles_are_on_the_ground_and_the_pelvis_above_the_origin() -> None:
    body = bending_body()
    away = torch.tensor([0.3, -0.2, -1.1])
    rig = dataclasses.replace(body.rig, vertices_m=body.rig.vertices_m + away, joints_m=body.rig.joints_m + away)
    staged = staged_without_shapes(dataclasses.replace(body, rig=rig))
    np.testing.assert_allclose(staged.rest_points_m[:, 1].min(), 0, atol=1e-6)
    np.testing.assert_allclose(staged.rigs["full"].skeleton.positions_m[:2], 0, atol=1e-6)


def test_the_root_is_at_the_ground_height_of_most_frames() -> None:
    """The lowest points of the four frames are at 0.5, 0.5, 0.3 and 0.5 m."""
    body = bending_body()
    body.root[2, 2, 3] -= 0.2
    motion = staged_without_shapes(body).rigs["full"].motions["captured"]
    np.testing.assert_allclose(motion.translations_m[:, 0, 1], 0.5, atol=1e-6)


def test_both_rigs_reproduce_the_bodys_surface(staged: StagedAvatar) -> None:
    for rig in staged.rigs.values():
        for found_m, true_m in zip(rig.surfaces_m("captured", staged.rest), staged.points_m, strict=True):
            np.testing.assert_allclose(found_m, true_m, atol=1e-5)


def test_blocks_of_a_motion_are_one_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = staged_without_shapes(bending_body())
    monkeypatch.setattr(rigs, "BLOCK", 3)
    for name, rig in staged_without_shapes(bending_body()).rigs.items():
        for motion, moving in rig.motions.items():
            expected = whole.rigs[name].motions[motion]
            np.testing.assert_array_equal(moving.translations_m, expected.translations_m)
            np.testing.assert_array_equal(moving.quaternions, expected.quaternions)


def test_a_long_motion_does_not_fill_the_memory() -> None:
    """The matrices of two joints, and of three in either rig, would take 1 KB a pose."""
    rig, poses = column_rig(), 20_000
    places = np.zeros((poses, 3)), np.zeros((poses, 0))
    motion = Motion(30.0, np.arange(float(poses)), np.tile(np.eye(3), (poses, 2, 1, 1)), *places)
    rest = RestSurface(rig.vertices_m.numpy(), np.zeros((0, *rig.vertices_m.shape)))
    tracemalloc.start()
    stage_rigs(rig, np.array([[0.0, 0, 0], [0, 0.8, 0]]), rest, {"captured": motion}, 0.0, "along")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak / poses < 1000


def test_other_frame_rates_resample_the_motion_at_whole_frames(staged: StagedAvatar) -> None:
    """Frames 3 to 8 at 10 a second run from 0.3 to 0.8 s: codes 8 to 19 at 24 a second, and 9 to 24 at 30, which
    include every captured frame."""
    motions = staged.rigs["full"].motions
    np.testing.assert_array_equal(motions["captured"].codes, FRAMES)
    np.testing.assert_array_equal(motions["captured_24"].codes, np.arange(8, 20))
    np.testing.assert_array_equal(motions["captured_30"].codes, np.arange(9, 25))
    surfaces_m = list(staged.rigs["full"].surfaces_m("captured_30", staged.rest))
    for frame, true_m in zip(FRAMES, staged.points_m, strict=True):
        np.testing.assert_allclose(surfaces_m[3 * frame - 9], true_m, atol=1e-5)


@pytest.mark.parametrize(("last", "rates"), [(21, (24, 30)), (22, ())])
def test_poses_far_apart_are_not_resampled(last: int, rates: tuple[int, ...]) -> None:
    """Four poses in 2.1 s at 10 frames a second are 0.7 s apart on average; in 2.2 s, too far apart."""
    staged = staged_without_shapes(dataclasses.replace(bending_body(), frames=(0, 2, 3, last)))
    assert staged.rates == rates
    assert list(staged.rigs["game"].motions) == ["captured", *(f"captured_{rate}" for rate in rates)]


def test_progress_is_reported_while_bounding_boxes_are_computed() -> None:
    heard: list[Progress] = []
    with listening(heard.append):
        staged = staged_without_shapes(bending_body())
    counts = {name: len(boxes_m) for name, boxes_m in staged.extents_m.items()}
    assert heard == [(f"boxes of {name}", done, count) for name, count in counts.items() for done in range(count + 1)]


def test_bounding_boxes_contain_the_surface_in_both_rigs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Here all points of the game rig follow the pelvis, so that the column stays upright where the full one bends."""

    def with_stiff_game_rig(*arguments: Any) -> dict[str, StagedRig]:
        staged = stage_rigs(*arguments)
        stiff = Skin(np.ones_like(staged["game"].skin.joints), staged["game"].skin.weights)
        return staged | {"game": dataclasses.replace(staged["game"], skin=stiff)}

    monkeypatch.setattr(staging, "stage_rigs", with_stiff_game_rig)
    staged = staged_without_shapes(bending_body())
    boxes_m = staged.extents_m["captured"]
    for rig in staged.rigs.values():
        surfaces_m = np.stack(list(rig.surfaces_m("captured", staged.rest)))
        assert (boxes_m[:, :1] <= surfaces_m).all() and (surfaces_m <= boxes_m[:, 1:]).all()


def test_a_vertex_has_the_colour_of_its_texel(staged: StagedAvatar) -> None:
    """One triangle lies on a texture of 4 x 4 texels whose red is the column and whose green is the row from the
    top."""
    texture = np.stack([*np.meshgrid(range(4), range(4)), np.zeros((4, 4))], -1).astype(np.uint8)
    uvs = np.array([[0.1, 0.9], [0.9, 0.9], [1.0, 0.0]])
    triangle = dataclasses.replace(
        staged,
        rest_points_m=np.zeros((3, 3)),
        levels=[Level(np.arange(3), np.array([[2, 0, 1]]), UvLayout(uvs, np.array([[0, 1, 2]])))],
        texture=texture,
    )
    np.testing.assert_array_equal(triangle.vertex_colours, [[3, 0, 0], [3, 3, 0], [0, 0, 0]])


def one_triangle(staged: StagedAvatar, shapes_m: np.ndarray, expressions_m: dict[str, np.ndarray]) -> StagedAvatar:
    """Return the avatar with a single triangle, whose second corner, on the x axis, the shapes move up, along z."""
    corners_m = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    level = Level(np.arange(3), np.array([[0, 1, 2]]), LAYOUT)
    parts: dict[str, Any] = {"shapes_m": shapes_m, "expressions_m": expressions_m, "physiques_m": {}}
    return dataclasses.replace(staged, rest_points_m=corners_m, levels=[level], **parts)


UP_1_M = np.array([[0, 0, 0], [0, 0, 1], [0, 0, 0]], np.float32)
TILTED = np.array([-np.sqrt(0.5), 0, np.sqrt(0.5) - 1])  # from (0, 0, 1) to the normal of a slope of 45 degrees


def test_normal_changes_of_correctives_add_up_like_their_offsets(staged: StagedAvatar) -> None:
    """With its corner raised by w, the triangle has the normal (-w, 0, 1) / sqrt(1 + w^2), whose derivative at w = 0 is
    (-1, 0, 0). Corrective shapes of 1 m and -1 m together move nothing, and must not turn the normal either."""
    changes = one_triangle(staged, np.stack([UP_1_M, -UP_1_M]), {"smile": UP_1_M}).normal_changes
    np.testing.assert_allclose(changes["corrective_01"], np.tile([-1, 0, 0], (3, 1)), atol=1e-3)
    np.testing.assert_allclose(changes["corrective_02"], np.tile([1, 0, 0], (3, 1)), atol=1e-3)
    np.testing.assert_allclose(changes["smile"], np.tile(TILTED, (3, 1)), atol=1e-6)


def test_a_mouth_that_is_closed_on_an_open_jaw_has_its_normals_of_before(staged: StagedAvatar) -> None:
    """`jawOpen` lowers the corner by 1 m, and `mouthClose` raises it by as much."""
    changes = one_triangle(
        staged, np.zeros((0, 3, 3), np.float32), {"jawOpen": -UP_1_M, "mouthClose": UP_1_M}
    ).normal_changes
    np.testing.assert_allclose(changes["jawOpen"], np.tile(TILTED * (-1, 1, 1), (3, 1)), atol=1e-6)
    np.testing.assert_allclose(changes["mouthClose"], -changes["jawOpen"], atol=1e-6)


def test_expressions_and_physiques_are_rotated_to_stage_axes(staged: StagedAvatar) -> None:
    stout_m = 0.3 * staged.rest_points_m * (1, 0, 1)  # the column stands on the vertical axis
    np.testing.assert_allclose(staged.physiques_m["stout"], stout_m, atol=1e-6)
    moved_m = staged.expressions_m["frown"]
    top = moved_points(moved_m)
    np.testing.assert_array_equal(top, np.flatnonzero(staged.rest_points_m[:, 1] > 1.65))  # the column was 5 cm lower
    np.testing.assert_allclose(moved_m[top], np.tile([0.01, 0.03, -0.02], (len(top), 1)), atol=1e-7)
    assert moved_points(np.full((4, 3), 1e-6)).tolist() == [0]


@pytest.mark.parametrize("up", ["y", "z"])
def test_quaternions_do_not_jump(up: str) -> None:
    turns = torch.linspace(0, 4 * torch.pi, 30)  # two full turns pass through -q
    body = bending_body()
    root = torch.eye(4).repeat(30, 1, 1)
    root[:, 0, 0], root[:, 0, 1], root[:, 1, 0], root[:, 1, 1] = turns.cos(), -turns.sin(), turns.sin(), turns.cos()
    spin = dataclasses.replace(body, frames=tuple(range(30)), theta=torch.zeros(30, 2, 3), root=root)
    rig = staged_without_shapes(spin, up).rigs["full"]
    q = rig.motions["captured"].quaternions
    along = (q[1:] * q[:-1]).sum(-1)
    assert along.min() > 0.9
    if up == "z":  # the root has all of it: 4 pi / 29 = 0.433 rad a step, and half of that between quaternions
        np.testing.assert_allclose(along[:, 0], np.cos(0.433 / 2), atol=1e-3)
        np.testing.assert_allclose(along[:, 1], 1, atol=1e-9)

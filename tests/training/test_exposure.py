"""Camera gains from the colours of body points that two cameras see."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from hnerf.avatar.avatar import Avatar
from hnerf.avatar.trained import build_field
from hnerf.capture.masks import Masks, encode
from hnerf.geometry.mesh_queries import Surface
from hnerf.training import exposure
from hnerf.training.exposure import _vertex_colours, _visible_vertices, camera_gains, solve_gains
from tests.training.scene import TINY, look_at, record

BALL = trimesh.creation.icosphere(subdivisions=5)  # 10242 vertices 1 m around the origin
RING = {name: look_at(name, 4.0 * np.array([x, y, 0]), np.zeros(3)).resized(128, 128)
        for name, x, y in [("a", 1, 0), ("b", 0, 1), ("c", -1, 0), ("d", 0, -1)]}  # fmt: skip


def photograph(name: str, gain: tuple[float, ...]) -> np.ndarray:
    """Return the image (128, 128, 3) of a ball, brighter above than below, from a camera of this gain."""
    camera = RING[name]
    y, x = np.mgrid[:128, :128]
    origin, directions = camera.rays(np.stack([x, y], -1).reshape(-1, 2).astype(float))
    points_on_rays = -(origin * directions).sum(1)
    missed2 = (origin**2).sum(1) - points_on_rays**2
    hit_m = origin + (points_on_rays - np.sqrt((1 - missed2).clip(0)))[:, None] * directions
    level = np.where(missed2 < 1, 100 + 40 * hit_m[:, 2], 128)
    return (level[:, None] * gain).round().reshape(128, 128, 3).astype(np.uint8)


def measured(gains: dict[str, tuple[float, float, float]], unmasked: str = "") -> Any:
    pictures = {name: photograph(name, gain) for name, gain in gains.items()}
    capture: Any = SimpleNamespace(
        train_cameras=tuple(gains), train_frames=(3,), cameras=RING, image=lambda name, frame: pictures[name]
    )
    body: Any = SimpleNamespace(
        vertices_m=lambda: torch.from_numpy(BALL.vertices.copy())[None],
        rig=SimpleNamespace(faces=torch.from_numpy(BALL.faces.copy())),
        index=lambda frame: 0,
    )
    masks = Masks({(name, 3): encode(np.ones((128, 128), bool)) for name in gains if name != unmasked}, {})
    return camera_gains(capture, masks, body)


def test_gains_equal_values_computed_by_hand() -> None:
    """b is twice as bright as a and c: relative to the mean of 2^(1/3), a and c are 1, b is 2. d shares no points."""
    twice = np.full((400, 3), np.log(2))
    logs = solve_gains(4, {(0, 1): twice, (1, 2): -twice})
    assert np.exp(logs[:, 0]) == pytest.approx([2 ** (-1 / 3), 2 ** (2 / 3), 2 ** (-1 / 3), 1])


def test_pairs_with_more_shared_points_have_more_weight() -> None:
    """The log ratios of three cameras in a ring contradict each other by 0.3, which is distributed in proportions of
    1 / 300, 1 / 300 and 1 / 100."""
    logs = solve_gains(3, {(0, 1): np.zeros((300, 3)), (1, 2): np.zeros((300, 3)), (0, 2): np.full((100, 3), 0.3)})
    assert logs[2, 0] - logs[0, 0] == pytest.approx(0.3 * (1 / 150) / (1 / 150 + 1 / 100))


def test_a_few_outlier_points_do_not_count() -> None:
    """Two of five ratios come from another limb: the median of 0.1, 0.2, 0.3, 5 and 9 is 0.3."""
    found = np.repeat([[0.1], [9], [0.3], [5], [0.2]], 3, axis=1)
    np.testing.assert_allclose(solve_gains(2, {(0, 1): found})[:, 0], [-0.15, 0.15])


def test_cameras_that_share_too_little_are_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exposure, "MIN_SHARED_VERTICES", len(BALL.vertices))
    assert measured({"a": (0.5, 0.5, 0.5), "b": (1, 1, 1)})[1].reason == "no two cameras to compare"


def test_colours_of_body_points_are_taken_from_usable_pixels() -> None:
    """Above row 48 one channel is 15; from row 80 down one is 245; left of column 64 the mask is empty."""
    picture, mask = np.full((128, 128, 3), 100, np.uint8), np.ones((128, 128), bool)
    picture[:48, :, 0], picture[80:, :, 2] = 15, 245
    mask[:, :64] = False
    capture: Any = SimpleNamespace(cameras=RING, image=lambda name, frame: picture)
    surface = Surface(BALL)
    levels = _vertex_colours(capture, Masks({("a", 3): encode(mask)}, {}), surface, "a", 3)
    seen, xy = _visible_vertices(RING["a"], surface)
    x, y = xy.T
    usable = np.zeros(len(seen), bool)
    usable[np.flatnonzero(seen)[(y >= 48) & (y < 80) & (x >= 64)]] = True
    assert usable.sum() > 100 and (levels[usable] == 100).all() and np.isnan(levels[~usable]).all()


def test_gains_of_cameras_that_see_the_same_ball() -> None:
    true = {"a": (0.8, 0.8, 0.9), "b": (1.2, 1.1, 1.0), "c": (1.0, 1.0, 1.0), "d": (1.1, 1.2, 1.0)}
    found, decision = measured(true)
    mean = np.exp(np.mean([np.log(gain) for gain in true.values()], 0))
    for name, gain in true.items():
        assert found[name] == pytest.approx(tuple(gain / mean), rel=0.01)
    assert "differ from the usual exposure by 27%" in decision.reason  # red of a: (1.2 x 1.1 / 0.8^3)^(1/4) = 1.267


def test_a_majority_of_equal_cameras_has_gain_one() -> None:
    """Other cameras, such as test cameras, most likely have the exposure of the majority."""
    found, decision = measured({"a": (1, 1, 1), "b": (1, 1, 1), "c": (1, 1, 1), "d": (1.5, 1.5, 1.5)})
    for name, gain in (("a", 1), ("b", 1), ("c", 1), ("d", 1.5)):
        assert found[name] == pytest.approx((gain,) * 3, rel=0.01)
    assert "differ from the usual exposure by 50%" in decision.reason


def test_a_camera_that_cannot_be_compared_has_gain_one() -> None:
    """a and b agree, c is brighter; d has no mask in the compared frame."""
    found, _ = measured({"a": (1, 1, 1), "b": (1, 1, 1), "c": (1.3, 1.3, 1.3), "d": (1, 1, 1)}, unmasked="d")
    assert [found[name][0] for name in "abcd"] == pytest.approx([1, 1, 1.3, 1], rel=0.01)


def test_small_differences_and_cameras_without_a_pair_are_not_corrected() -> None:
    assert measured({"a": (1, 1, 1), "b": (1.1, 1, 1), "c": (1, 1, 1), "d": (1, 1, 1)})[0] == {}
    assert measured({"a": (0.5, 0.5, 0.5), "c": (1, 1, 1)})[1].reason == "no two cameras to compare"  # back to back
    assert measured({"a": (0.5, 0.5, 0.5)})[0] == {}


def test_hidden_and_grazing_vertices_are_not_visible() -> None:
    """A ball of a quarter of the size between camera a and the other ball hides its middle."""
    small = trimesh.creation.icosphere(subdivisions=4, radius=0.25).apply_translation([2, 0, 0])
    seen, _ = _visible_vertices(RING["a"], Surface(trimesh.util.concatenate([BALL, small])))
    places = BALL.vertices[seen[: len(BALL.vertices)]]
    assert len(places) > 100
    assert (np.hypot(places[:, 1], places[:, 2]) / (4 - places[:, 0]) > 0.12).all()  # outside the small ball's cone
    assert seen[len(BALL.vertices) :].any()
    towards = (RING["a"].centre_m - places) / np.linalg.norm(RING["a"].centre_m - places, axis=1, keepdims=True)
    assert 0.4 < (towards * places).sum(1).min() < 0.42  # points seen at a flatter angle are not used
    turned = np.diag([-1.0, 1, -1])
    away = dataclasses.replace(RING["a"], R=turned @ RING["a"].R, t_m=turned @ RING["a"].t_m)
    assert not _visible_vertices(away, Surface(BALL))[0].any()  # the ball is behind the camera


def test_rendering_a_training_camera_applies_its_gain(tmp_path: Path) -> None:
    capture, _, body = record(tmp_path)
    avatar = Avatar(build_field(TINY.field, body, False), body, body, {"0": (0.5, 1.0, 2.0)})
    plain = Avatar(avatar.field, body, body)
    for name, gain in (("0", (0.5, 1.0, 2.0)), ("1", (1.0, 1.0, 1.0))):
        shown, expected = (a.render(capture.cameras[name], body.theta[0], body.root[0]).rgb for a in (avatar, plain))
        assert expected.max() > 0.1
        assert torch.equal(shown, (expected * torch.tensor(gain)).clamp(0, 1))

"""Automatic settings, compared with values computed by hand, and the measurement of a scene."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hnerf.capture.masks import Masks, encode
from hnerf.config import TrainingSettings
from hnerf.training import auto_settings
from hnerf.training.auto_settings import SceneStatistics, decide
from tests.training.scene import SIZE_PX, record

SCENE = SceneStatistics(
    cameras=4,
    frames=24,
    footprint_m=0.02,
    outside_m=0.035,
    inside_m=0.005,
    side_m=1.92,
    std_rad=0.3,
    person_px=4_000_000,
    lowest_m=(0.005, -0.02),
)


def decided(scene: SceneStatistics, **given: object) -> tuple[TrainingSettings, dict]:
    settings = TrainingSettings.model_validate({"frames_per_step": 10, "rays_per_frame": 250} | given)
    return decide(scene, settings)


def test_settings_equal_values_computed_by_hand():
    """Pixels of 2 cm give 96 cells on 1.92 m, in levels from 24 by factors of 4 ** (1 / 3); for geometry 64, in levels
    from 16 by factors of 2. Masks reach 3.5 cm out and 0.5 cm in. With a margin of 1.5 cm, the shell is 5 cm, and the
    minimum of 3 cm. Samples are 6 mm apart, not 0.6 cells of 2 cm. Four million pixels at 2500 per step, each drawn
    1.5 times: 2400 steps."""
    settings, decisions = decided(SCENE)
    fast = settings.field
    assert fast.colour_cells == (24, 38, 60, 96)
    assert fast.geometry_cells == (16, 32, 64)
    assert (fast.outer_m, fast.inner_m, fast.spacing_m) == (0.05, 0.03, 0.006)
    assert (fast.pose_width, settings.steps) == (8, 2400)
    assert decisions["field.spacing_m"].reason == "0.6 cells of 20.0 mm, at most 6.0 mm"


@pytest.mark.parametrize(
    ("changed", "given", "expected"),
    [
        # Pixels of 1 mm would give 1920 cells, but frames align only to 1 cm.
        ({"footprint_m": 0.001}, {}, {"colour_cells": (24, 48, 96, 192), "geometry_cells": (16, 45, 128)}),
        # Pixels of 10 cm give 19 cells, and 13 for geometry: fewer than the coarsest levels, 24 and 16.
        ({"footprint_m": 0.1}, {}, {"colour_cells": (19,), "geometry_cells": (13,)}),
        # 128 / 1.5 = 85, whatever the pixel size.
        ({}, {"colour_cells": [24, 128]}, {"geometry_cells": (16, 37, 85)}),
        # A skirt reaches 30 cm out from the body, the shell at most 15.
        ({"outside_m": 0.3}, {}, {"outer_m": 0.15, "inner_m": 0.03}),
    ],
    ids=["small pixels", "large pixels", "given cells", "skirt"],
)
def test_cells_and_shell_by_hand(changed: dict, given: dict, expected: dict):
    fast = decided(replace(SCENE, **changed), field={"kind": "fast"} | given)[0].field
    assert {name: getattr(fast, name) for name in expected} == expected


@pytest.mark.parametrize("nearly_static", [{"frames": 1}, {"std_rad": 0.001}])
def test_with_one_posture_cells_are_as_fine_as_pixels(nearly_static: dict):
    """Cells shrink to 8 mm: 240 on 1.92 m, 160 for geometry. Samples are 0.6 cells apart, 4.8 mm."""
    for footprint_m in (0.008, 0.001):
        settings, decisions = decided(replace(SCENE, footprint_m=footprint_m, **nearly_static))
        assert (settings.field.colour_cells[-1], settings.field.geometry_cells[-1]) == (240, 160)
        assert settings.field.spacing_m == pytest.approx(0.0048)
        assert "there is one posture: cells of 8.0 mm" in decisions["field.colour_cells"].reason


def test_given_settings_are_kept():
    settings, decisions = decided(SCENE, steps=7, field={"kind": "fast", "spacing_m": 0.005, "outer_m": 0.2})
    assert (settings.steps, settings.field.spacing_m, settings.field.outer_m) == (7, 0.005, 0.2)
    open_ones = ("inner_m", "colour_cells", "geometry_cells", "pose_width", "nodes")
    assert set(decisions) == {*(f"field.{name}" for name in open_ones), "one_posture", "ground"}


@pytest.mark.parametrize(
    ("kind", "std_rad", "one"), [("fast", 0.001, True), ("fast", 0.003, False), ("paper", 0.001, False)]
)
def test_frames_fitted_with_one_posture_keep_one(kind: str, std_rad: float, one: bool):
    """The published method gives each frame its own posture; a given setting is kept."""
    scene = replace(SCENE, std_rad=std_rad)
    assert decided(scene, field={"kind": kind})[0].one_posture is one
    assert decided(scene, one_posture=not one)[0].one_posture is not one


@pytest.mark.parametrize(("person_px", "steps"), [(1000, 600), (10**9, 4000)])
def test_steps_are_limited(person_px: int, steps: int):
    assert decided(replace(SCENE, person_px=person_px))[0].steps == steps


@pytest.mark.parametrize(
    ("cameras", "frames", "rate", "steps"),
    [(1, 40, 5e-4, 1080), (4, 40, 5e-4, 600), (1, 1, 5e-4, 600), (1, 40, 0, 600)],
)
def test_one_camera_gets_more_steps_to_find_the_depth_of_bodies(cameras: int, frames: int, rate: float, steps: int):
    """270 steps per frame for 40 frames at 10 frames per step are 1080; one frame or given poses need no depth
    search."""
    scene = replace(SCENE, cameras=cameras, frames=frames, person_px=1000)
    settings, decisions = decided(scene, pose_learning_rate=rate)
    assert settings.steps == steps
    assert ("depths of 40 bodies" in decisions["steps"].reason) == (steps == 1080)


def test_with_nearly_one_pose_the_pose_network_is_minimal():
    settings, decisions = decided(replace(SCENE, std_rad=0.01))
    assert settings.field.pose_width == 1
    assert decisions["field.pose_width"].reason.endswith("too little to learn from")


@pytest.mark.parametrize(
    ("cameras", "frames", "rate", "nodes"), [(4, 24, 1e-3, 128), (4, 1, 1e-3, 0), (1, 24, 1e-3, 0), (4, 24, 0.0, 0)]
)
def test_a_single_frame_or_camera_does_not_deform_the_body(cameras: int, frames: int, rate: float, nodes: int):
    scene = replace(SCENE, cameras=cameras, frames=frames)
    assert decided(scene, field={"kind": "fast", "deformation_learning_rate": rate})[0].field.nodes == nodes


@pytest.mark.parametrize(
    ("lowest_m", "ground"),
    [
        ((-0.01, -0.03), True),
        ((0.028, 0.01), True),
        ((0.04, 0.01), False),
        ((-0.04, -0.045), False),
        ((0, -0.06), False),
    ],
)
def test_the_ground_is_used_only_if_feet_stand_on_it_and_not_below(lowest_m: tuple[float, float], ground: bool):
    scene = replace(SCENE, lowest_m=lowest_m)
    assert decided(scene)[0].ground is ground
    assert decided(scene, ground=not ground)[0].ground is not ground


def test_measured_statistics_of_a_scene(tmp_path: Path):
    """Cameras at 4.03 m with a focal length of 38.4 px: 0.105 m per pixel. The masks are the body's own silhouettes,
    whose outermost pixels are the outline: 0.5 to 1.5 pixels inside. One of two joints is free and bends by 0 and 0.2
    rad in the two training frames: a standard deviation of 0.1 rad."""
    capture, masks, body = record(tmp_path / "capture")
    scene = SceneStatistics.of(capture, masks, body)
    assert (scene.cameras, scene.frames) == (4, 2)
    assert scene.footprint_m == pytest.approx(0.105, abs=0.003)
    assert scene.outside_m == 0.0
    assert 0.09 < scene.inside_m < 0.2
    assert scene.side_m == pytest.approx(2.0)
    assert scene.std_rad == pytest.approx(0.1)
    assert scene.lowest_m == pytest.approx((0.0, 0.0), abs=1e-6)
    areas = [masks.get(c, f).sum() for c in capture.train_cameras for f in capture.train_frames]
    assert scene.person_px == pytest.approx(np.sum(areas), rel=0.01)


def test_person_pixels_count_all_masks_of_a_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """One mask per camera is measured. Camera 0 has one of 32 x 32 pixels, each other camera two of 10 x 10: 1024 + 3 x
    2 x 100. Then the masks of camera 3 are removed."""
    monkeypatch.setattr(auto_settings, "MASKS_PER_CAMERA", 1)
    capture, _, body = record(tmp_path)
    whole, part = np.ones((SIZE_PX, SIZE_PX), bool), np.zeros((SIZE_PX, SIZE_PX), bool)
    part[11:21, 11:21] = True
    masks = {("0", 0): encode(whole)} | {(camera, frame): encode(part) for camera in "123" for frame in (0, 1)}
    assert SceneStatistics.of(capture, Masks(masks, {}), body).person_px == 1624
    del masks["3", 0], masks["3", 1]
    assert SceneStatistics.of(capture, Masks(masks, {}), body).person_px == 1424


def test_shells_contain_99_percent_of_outline_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Outline points lie from 50 pixels inside to 50 outside: percentile 99 of -50, -49, ... 50 is 49, percentile 1 is
    -49."""
    monkeypatch.setattr(auto_settings, "_outline_distance_px", lambda mask, covered: np.arange(-50.0, 51.0))
    monkeypatch.setattr(auto_settings, "MASKS_PER_CAMERA", 1)
    capture, masks, body = record(tmp_path)
    scene = SceneStatistics.of(replace(capture, train_cameras=("0",)), masks, body)
    assert scene.outside_m == pytest.approx(49 * scene.footprint_m)
    assert scene.inside_m == pytest.approx(49 * scene.footprint_m)


@pytest.mark.parametrize("close", [False, True])
def test_masks_are_not_measured_where_the_image_has_no_outline_of_the_body(tmp_path: Path, close: bool):
    """In frame 0 only a sleeve is left in the image, not the body; or the body fills the image, where masks have a
    hole. Distances to an outline that is not there would make the shell as thick as it can be."""
    capture, masks, body = record(tmp_path)
    alone = replace(capture, train_cameras=("0",))
    camera = capture.cameras["0"]
    body.root[0, :3, 3] += torch.from_numpy(-3.9 * camera.forward if close else 20 * camera.R[0]).float()
    mask = np.full((SIZE_PX, SIZE_PX), close)
    mask[8:24, -2:] = not close
    seen = Masks(masks.encoded | {("0", 0): encode(mask)}, {})
    scene = SceneStatistics.of(alone, seen, body)
    assert max(scene.outside_m, scene.inside_m) < 1


def test_the_ground_is_judged_by_training_frames_only(tmp_path: Path) -> None:
    """In the novel frame, the third, the body is a metre lower."""
    capture, masks, body = record(tmp_path)
    body.root[2, 2, 3] -= 1
    assert SceneStatistics.of(capture, masks, body).lowest_m == pytest.approx((0.0, 0.0), abs=1e-6)

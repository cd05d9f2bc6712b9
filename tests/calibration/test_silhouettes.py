"""Outlines of a box with exact masks: the convex hulls of its projected corners."""

import dataclasses
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest

from hnerf.calibration import silhouettes
from hnerf.calibration.silhouettes import BEHIND_CAMERA_PX, MaskOutline, Outlines, _outside_px
from hnerf.capture.capture import Capture, SubjectPoint
from hnerf.geometry.camera import Camera
from tests.calibration.synthetic import SIZE_PX, look_at, ring, turned
from tests.capture.test_subject import recorded, staying

CORNERS_M = np.array(list(product([-0.2, 0.2], [-0.3, 0.3], [0.1, 1.7])))


def mask(camera: Camera, corners_m: np.ndarray = CORNERS_M) -> np.ndarray:
    """Return the mask of a box, drawn to 1/256 px, so that pixels are inside if their centres are."""
    corners_px = (camera.project(corners_m)[0] * 256).round().astype(np.int32)
    drawn = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
    cv2.fillConvexPoly(drawn, cv2.convexHull(corners_px), 1, lineType=cv2.LINE_8, shift=8)
    return drawn.astype(bool)


def outlines(cameras: list[Camera], corners_m: np.ndarray = CORNERS_M) -> Outlines:
    return Outlines({camera.name: [MaskOutline.around(mask(camera, corners_m))] for camera in cameras}, (0,))


def test_distances_and_points_of_an_outline_by_hand() -> None:
    square = np.zeros((20, 30), bool)
    square[5:15, 10:20] = True
    square[8:10, 12:14] = False  # a hole and a speck, errors of the mask
    square[0, 0] = True
    found = MaskOutline.around(square)
    assert found is not None
    assert found.distance_px[10, 25] == 5.5 and found.distance_px[10, 15] == -4.5 and found.distance_px[9, 13] < 0
    # The edge lies half a pixel outside the centres of the first and last pixels inside.
    assert found.points_px.min(0) == pytest.approx([9.5, 4.5]) and found.points_px.max(0) == pytest.approx([19.5, 14.5])
    assert found.centre_px == pytest.approx([14.5, 9.5])


def test_there_is_no_outline_at_the_image_border() -> None:
    assert MaskOutline.around(np.zeros((20, 30), bool)) is None
    cut_off = np.zeros((20, 30), bool)
    cut_off[10:, 5:15] = True
    found = MaskOutline.around(cut_off)
    assert found is not None and found.points_px[:, 1].max() < 18
    assert MaskOutline.around(np.ones((20, 30), bool)) is None  # the camera stands too near to see any edge


def test_a_point_behind_a_camera_is_outside_its_mask() -> None:
    """The middle of the box, and its mirror image behind the camera, which would project to the same pixel."""
    camera = ring(1)[0]
    outline, middle_m = MaskOutline.around(mask(camera)), CORNERS_M.mean(0)
    assert outline is not None
    both_m = np.stack([middle_m, 2 * camera.centre_m - middle_m])
    found_px = _outside_px(camera, outline, both_m[None])[0]
    assert found_px[0] < -10 and found_px[1] == BEHIND_CAMERA_PX


def test_a_true_rig_has_almost_no_cost() -> None:
    cameras = ring(4)
    residuals_px = np.concatenate(list(outlines(cameras).residuals_px(cameras).values()))
    assert residuals_px.max() < 1.5
    assert outlines(cameras).cost_px(cameras) < 0.05


def test_the_residual_of_a_pitched_camera_by_hand() -> None:
    # Two cameras at a right angle, level with the box's middle. One degree moves the image of c0 by 17.5 px: the rays
    # of its lower or upper edge miss c1's box by that much, those of the other three edges go through it.
    centres_m = {"c0": [3.5, 0, 0.9], "c1": [0, 3.5, 0.9]}
    cameras = [look_at(name, np.array(at), np.array([0, 0, 0.9])) for name, at in centres_m.items()]
    seen = outlines(cameras)
    off = [turned(cameras[0], 1.0, axis=0), cameras[1]]
    residuals_px = seen.residuals_px(off)["c0"]
    assert residuals_px.max() == pytest.approx(17.5, abs=1.5)
    outline = seen.by_camera["c0"][0]
    assert outline is not None
    wrong_way = outline.points_px[residuals_px > 3, 1]
    assert len(wrong_way) > 2 and np.ptp(wrong_way) < 60


def test_a_rig_with_a_turned_camera_costs_more() -> None:
    cameras = ring(4)
    seen = outlines(cameras)
    for i, axis in product(range(4), (0, 1)):
        off = [turned(camera, 1.0, axis) if j == i else camera for j, camera in enumerate(cameras)]
        assert seen.cost_px(off) > 0.5


def test_a_camera_without_masks_is_left_out() -> None:
    cameras = ring(4)
    partly = Outlines(dict(outlines(cameras[:3]).by_camera) | {"c3": [None]}, (0,))
    residuals_px = partly.residuals_px([*cameras[:3], turned(cameras[3], 20)])
    assert len(residuals_px["c3"]) == 0 and len(residuals_px["c0"]) > 30
    assert max(row.max() for row in residuals_px.values() if len(row)) < 1.5


def test_changes_near_the_hull_match_recomputed_residuals() -> None:
    """Every camera is turned by half a degree, so that rays miss the hull. Each in turn is moved by 3 mm; at a distance
    of 3.5 m and a focal length of 1000 px, rays change by up to 0.86 px. A camera without outlines changes nothing."""
    seen = outlines(ring(4))
    given = [turned(camera, 0.5, axis=i % 2) for i, camera in enumerate(ring(4))]
    given.append(dataclasses.replace(given[0], name="without outlines"))
    moved = [dataclasses.replace(camera, t_m=camera.t_m + np.array([0.003, 0, 0])) for camera in given]
    found_px = seen.near_hull(given).changes_px([[camera] for camera in moved])
    before_px = np.concatenate([*seen.residuals_px(given).values()])
    for i, changed_px in enumerate(found_px[:4]):
        anew = seen.residuals_px([*given[:i], moved[i], *given[i + 1 :]])
        off_px = np.abs(changed_px - (np.concatenate([*anew.values()]) - before_px))
        assert off_px.max() < 0.15
        assert 0.5 < np.abs(changed_px).max() < 1.2
        own = slice(i * len(anew["c0"]), (i + 1) * len(anew["c0"]))
        assert np.abs(changed_px[own]).max() > 0.3
    assert (found_px[4] == 0).all()


def test_changes_near_the_hull_include_rays_that_leave_it() -> None:
    """A camera of a true rig is moved from 1.5 mm left to 1.5 mm right: rays at one side leave the hull."""
    seen, rig = outlines(ring(4)), ring(4)
    left, right = (dataclasses.replace(rig[0], t_m=rig[0].t_m + np.array([x, 0, 0])) for x in (-0.0015, 0.0015))
    before_px, after_px = (np.concatenate([*seen.residuals_px([c, *rig[1:]]).values()]) for c in (left, right))
    found_px = seen.near_hull([left, *rig[1:]]).changes_px([[right]])[0]
    np.testing.assert_allclose(found_px, after_px - before_px, atol=0.15)
    assert found_px[before_px == 0].max() > 0.2


@pytest.fixture(scope="module")
def wave_outlines(wave: Capture) -> Outlines:
    found = Outlines.of(wave)
    assert found is not None
    return found


def test_outlines_of_a_rendered_capture_reveal_a_turned_camera(wave: Capture, wave_outlines: Outlines) -> None:
    cameras = [wave.cameras[name] for name in wave.train_cameras]
    assert wave_outlines.cost_px(cameras) < 0.05
    for i, camera in enumerate(cameras):
        off = turned(camera, 1.0, axis=i % 2)
        assert wave_outlines.cost_px([off if j == i else other for j, other in enumerate(cameras)]) > 0.1


def test_wrong_cameras_do_not_change_the_masks(wave: Capture, wave_outlines: Outlines) -> None:
    inverted = {
        name: dataclasses.replace(c, R=c.R.T, t_m=-c.R.T @ c.t_m) for name, c in wave.cameras.items()
    }  # fmt: skip
    found = Outlines.of(wave.with_cameras(inverted))
    assert found is not None
    for name in wave.train_cameras:
        for one, other in zip(wave_outlines.by_camera[name], found.by_camera[name], strict=True):
            assert one is not None and other is not None
            np.testing.assert_allclose(one.distance_px, other.distance_px, atol=1e-4)  # OpenCV's last bits vary


def test_outlines_show_the_subject_that_the_recording_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The person is named in one camera and found in the others, too."""
    capture, each = recorded(tmp_path, ring(3), staying((0, -0.6)), staying((0, 0.6)))
    x, y, _ = each[1]["c1"][7, 0]
    monkeypatch.setattr(silhouettes, "background_subtraction", lambda *_: lambda frame, prior: prior.body)
    found = Outlines.of(dataclasses.replace(capture, subject_point=SubjectPoint((x, y), "c1", 7)))
    assert found is not None and found.by_camera.keys() == {"c0", "c1", "c2"}
    for name, (outline, *_) in found.by_camera.items():
        hip_px, other_px = (one[name][found.instants[0], 8, :2].round().astype(int) for one in (each[1], each[0]))
        assert outline is not None
        assert outline.distance_px[hip_px[1], hip_px[0]] < 0 < outline.distance_px[other_px[1], other_px[0]]

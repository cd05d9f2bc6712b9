import dataclasses
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.capture import write_image
from hnerf.config import SegmentationSettings
from hnerf.segmentation.backends import given_mask
from hnerf.segmentation.prior import (
    _completed_pose,
    _consistent_keypoints,
    _interpolated,
    _stick_figure,
    bounding_window,
    camera_priors,
)
from tests.calibration.synthetic import SIZE_PX, detections, edited_keypoints, ring, turned, write_capture
from tests.segmentation.scene import write_likely, write_scene

HEAD, LEGS, FEET = [0, 15, 16, 17, 18], [10, 11, 13, 14, *range(19, 25)], list(range(19, 25))
HIPS = [8, 9, 12]


def test_the_window_of_a_region_has_a_margin_of_12_px_within_the_image() -> None:
    region = np.zeros((60, 50), bool)
    assert bounding_window(region) == (slice(0), slice(0))
    region[20:23, 5:8] = True
    assert bounding_window(region) == (slice(8, 35), slice(0, 20))


@pytest.mark.parametrize(
    ("cameras", "unseen", "after"),
    [(2, HEAD, 0), (2, HEAD, 1), (1, HEAD, 0), (1, LEGS, 0), (2, FEET, 0), (1, HIPS, 0)],
    ids=["head in one camera of two", "head later on", "head in the only camera", "legs", "feet", "hips"],
)
def test_body_parts_without_keypoints_are_within_reach(
    tmp_path: Path, cameras: int, unseen: list[int], after: int
) -> None:
    capture, truth = write_scene(tmp_path, cameras, moves_m=2.0)
    with edited_keypoints(tmp_path) as found:
        found["c0"][after:, :, unseen] = 0
        if unseen == FEET:
            found["c1"][:, :, unseen] = 0
    priors = dict(camera_priors(capture, None, SegmentationSettings()))
    for (camera, frame), person in truth.items():
        assert priors[camera](frame).reach[person].all()


def test_a_networks_mask_locates_the_subject(tmp_path: Path) -> None:
    """The prior's body is where the subject, not the poster, is more likely than not; its core is surely the subject.
    If the network missed the subject, the stick figure is used."""
    capture, truth = write_scene(tmp_path, 2)
    sticks = dict(camera_priors(capture, None, SegmentationSettings()))
    write_likely(capture, truth | {("c0", 3): np.zeros_like(truth["c0", 3])})
    found = dict(camera_priors(capture, None, SegmentationSettings()))
    for (camera, frame), person in truth.items():
        prior = found[camera](frame)
        if (camera, frame) == ("c0", 3):
            assert np.array_equal(prior.body, sticks[camera](frame).body)
            continue
        assert (prior.body & person).sum() / (prior.body | person).sum() > 0.9
        assert (prior.core & ~person).sum() < 0.001 * person.sum() < prior.core.sum() / 200  # the blur closed a hole
        assert not prior.reach[:40, :30].any()
        assert prior.reach.sum() < 0.8 * sticks[camera](frame).reach.sum()


def test_a_detection_far_outside_the_image_is_drawn_at_a_limited_distance(tmp_path: Path) -> None:
    capture, truth = write_scene(tmp_path, 1)
    with edited_keypoints(tmp_path) as found:
        found["c0"][0, 0, 4, :2] = 1e7, -1e9
    prior = dict(camera_priors(capture, None, SegmentationSettings()))["c0"](0)
    assert 5 * 400 < prior.height_px < 6 * 400  # from 5 heights above the image to the feet in it
    assert prior.reach[truth["c0", 0]].all()


def test_a_camera_that_looks_away_from_the_person_sees_nobody(tmp_path: Path) -> None:
    """Two of three cameras see the person, who stands behind the third and must not be drawn mirrored in its image. A
    mask given there shows somebody else."""
    cameras = ring(3)
    seen = detections(cameras, 0.5)
    seen[2, ..., 2] = 0
    away = turned(cameras[2], 180)
    capture = write_capture(tmp_path, [*cameras[:2], away], seen)
    found = _consistent_keypoints(capture, None)
    assert np.isfinite(found["c0"]).all() and np.isinf(found["c2"]).all()
    figure = _stick_figure(away, found["c2"][0])
    assert not figure.completed.any() and figure.height_px == 0 and figure.behind
    stranger = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
    stranger[300:900, 400:600] = 255
    write_image(tmp_path / "masks" / "c2" / "000000.png", stranger)
    prior = dict(camera_priors(capture, None, SegmentationSettings()))["c2"](0)
    assert prior.elsewhere and not given_mask(capture, "c2", 0, prior).any()


def test_unseen_head_and_legs_are_put_in_line_with_the_trunk_by_hand() -> None:
    # Neck at (50, 20), mid-hip at (50, 40), the left knee seen off that line; nothing else is seen.
    pose_px = np.full((25, 2), np.nan)
    pose_px[1], pose_px[8], pose_px[12], pose_px[13] = (50, 20), (50, 40), (52, 40), (60, 50)
    likely = _completed_pose(pose_px)
    assert likely[0].tolist() == [50, 11]  # 0.45 of 20 px above the neck
    assert likely[10].tolist() == [50, 56]  # 0.8 of 20 px below the mid-hip, as no hip is seen
    assert likely[11].tolist() == [50, 72]
    assert likely[14].tolist() == [68, 60]  # as far again as from hip to knee
    assert np.isnan(likely[4]).all()
    pose_px[2] = 45, 20
    assert _completed_pose(pose_px)[9].tolist() == [46, 40]  # 0.8 of the shoulder's 5 px to the side of the mid-hip
    pose_px[[17, 18]] = (46, 12), (48, 14)
    assert _completed_pose(pose_px)[0].tolist() == [47, 13]  # between the points seen of the face


def test_unseen_hips_are_put_in_line_with_the_head_by_hand() -> None:
    """The nose is 9 px above the neck at (50, 20): the mid-hip is 9 / 0.45 = 20 px below it."""
    pose_px = np.full((25, 2), np.nan)
    pose_px[0], pose_px[1], pose_px[2], pose_px[5] = (50, 11), (50, 20), (45, 20), (55, 20)
    likely = _completed_pose(pose_px)
    assert likely[[8, 9, 12]] == pytest.approx(np.array([[50, 40], [46, 40], [54, 40]]))
    assert likely[10] == pytest.approx([46, 56])


def test_unseen_keypoints_move_with_the_mid_hip_by_hand() -> None:
    # The mid-hip walks 10 px a frame; the nose is seen 50 px above it at first and not again.
    tracks = np.full((3, 25, 2), np.nan)
    tracks[:, 8] = [[0, 100], [10, 100], [20, 100]]
    tracks[0, 0] = [0, 50]
    assert _interpolated(tracks, (3, 4, 5))[:, 0].tolist() == [[0, 50], [10, 50], [20, 50]]
    assert np.isnan(_interpolated(tracks, (3, 4, 5))[:, 5]).all()
    tracks[:, 8] = np.nan
    assert _interpolated(tracks, (3, 4, 5))[:, 0].tolist() == [[0, 50]] * 3


def test_gaps_are_filled_by_frame_number_by_hand() -> None:
    # The mid-hip walks 10 px a frame, and is not seen in frame 6, after which the next frame is 15.
    tracks = np.full((4, 25, 2), np.nan)
    tracks[[0, 1, 3], 8] = [[0, 100], [10, 100], [110, 100]]
    assert _interpolated(tracks, (4, 5, 6, 15))[2, 8].tolist() == [20, 100]


def test_person_masks_count_only_if_all_training_cameras_have_them(tmp_path: Path) -> None:
    """As when only cameras without keypoints were searched."""
    capture, truth = write_scene(tmp_path, 2)
    write_likely(capture, {view: mask for view, mask in truth.items() if view[0] == "c0"})
    assert not capture.has_person_masks
    write_likely(capture, truth)
    assert capture.has_person_masks


def test_only_in_an_upright_image_nothing_is_expected_far_below_the_person(tmp_path: Path) -> None:
    """A camera that is mounted upside down shows the same image: what is below in it is above in the world."""
    capture, _ = write_scene(tmp_path)
    camera = capture.cameras["c0"]
    flipped = capture.with_cameras({"c0": dataclasses.replace(camera, R=np.diag([-1.0, -1, 1]) @ camera.R)})
    upright, upside_down = (dict(camera_priors(c, None, SegmentationSettings()))["c0"](0) for c in (capture, flipped))
    lowest, reached, below = (
        int(np.flatnonzero(m.any(1))[-1]) for m in (upright.body, upright.reach, upside_down.reach)
    )
    assert reached == lowest + int(0.06 * upright.height_px)
    assert below > lowest + 0.06 * upright.height_px + 5

import json
import shutil
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from hnerf.capture.capture import Capture, read_rgb, write_image
from hnerf.capture.given_poses import GivenPoses
from hnerf.capture.masks import Masks, encode, movement_px
from hnerf.config import SegmentationSettings
from hnerf.errors import InputError
from hnerf.segmentation.backends import given_mask
from hnerf.segmentation.cut import components_within
from hnerf.segmentation.difference import difference, exposure_corrected, masked_median, noise_level, visible_background
from hnerf.segmentation.edge import refine_edge
from hnerf.segmentation.prior import Prior
from hnerf.segmentation.segment import segment
from tests.calibration.synthetic import edited_keypoints
from tests.segmentation.scene import only_frames, write_likely, write_masks, write_scene
from tests.shared_data import shared_capture

SETTINGS = SegmentationSettings()


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_a_shadow_is_not_the_person_by_hand() -> None:
    # Left: the plate at 60 % brightness in all channels (a shadow); right: another colour of similar brightness.
    plate = np.full((40, 80, 3), (150, 120, 90), np.uint8)
    image = plate.copy()
    image[10:30, 10:30] = (90, 72, 54)
    image[10:30, 50:70] = (54, 72, 90)
    found = difference(image, plate, noise_level(image, plate, np.ones((40, 80), bool)))
    assert (found.log_odds[12:28, 12:28] < -1).all()
    assert (found.log_odds[12:28, 52:68] > 4).all()
    assert (found.log_odds[:8] < -4).all()
    assert (found.contrast[:8] == 128).all()


@pytest.mark.parametrize("tint", [(0, 0, 0), (-2, 0, -3)], ids=["grey", "grey with the tint of a video's decoder"])
def test_in_grey_images_a_dark_region_may_be_a_person_or_a_shadow(tint: tuple[int, ...]) -> None:
    """Left: the plate at 60 % brightness, where a person is at most e^1 times more or less likely than a shadow; right:
    darker than any shadow."""
    plate = np.full((40, 80, 3), 150, np.uint8)
    image = plate.copy()
    image[10:30, 10:30], image[10:30, 50:70] = 90, 20
    image, plate = ((pixels + np.array(tint)).astype(np.uint8) for pixels in (image, plate))
    found = difference(image, plate, noise_level(image, plate, np.ones((40, 80), bool)))
    assert (np.abs(found.log_odds[12:28, 12:28]) < 1).all()
    assert (found.log_odds[12:28, 52:68] > 4).all()
    assert (found.log_odds[:8] < -4).all()


def test_noise_and_exposure_are_measured_on_the_background_by_hand() -> None:
    """The person covers two thirds of the image. Elsewhere the image is 20 % brighter than the plate, once LOG_OFFSET
    is added to both: 150 + 6 against 124 + 6, with noise of 2 levels up and down."""
    plate, image = np.full((8, 30, 3), 124, np.uint8), np.full((8, 30, 3), 150, np.uint8)
    image[:, :20] = 30
    image[::2, 20:] += 2
    image[1::2, 20:] -= 2
    body = np.zeros((8, 30), bool)
    body[:, :20] = True
    free = visible_background(Prior(body, body, body, body, 8.0), np.ones_like(body))
    assert free.tolist() == (~body).tolist()
    bright = exposure_corrected(plate, image, free)
    assert np.unique(bright).tolist() == [150]
    assert noise_level(image, bright, free) == pytest.approx(1.4826 * 2 + 0.5)
    assert exposure_corrected(image, image, free) is image
    assert noise_level(image, bright, body) == pytest.approx(1.4826 * 120 + 0.5)  # on the person: 150 against 30


def test_background_is_taken_nearer_to_the_person_if_too_little_is_visible() -> None:
    wide, narrow = np.ones((10, 10), bool), np.zeros((10, 10), bool)
    narrow[2:] = True
    known = np.ones_like(wide)
    assert visible_background(Prior(narrow, narrow, narrow, wide, 8.0), known).tolist() == (~narrow).tolist()
    known[0] = False
    assert visible_background(Prior(narrow, narrow, wide, wide, 8.0), known).sum() == 10
    assert exposure_corrected(np.zeros((10, 10, 3), np.uint8), np.ones((10, 10, 3), np.uint8), ~wide).max() == 0


def test_only_a_median_plate_may_itself_contain_shadows() -> None:
    # The image is 1 / 0.6 as bright as the plate, in all channels.
    plate = np.full((8, 8, 3), (90, 72, 54), np.uint8)
    image = np.full((8, 8, 3), (150, 120, 90), np.uint8)
    assert (difference(image, plate, 1.0).log_odds > 4).all()
    assert (difference(image, plate, 1.0, shadowed=True).log_odds < 0).all()


def test_masked_median_by_hand() -> None:
    # The first pixel's values over five frames; the person (200) hides it in three. The median of 10 and 30 is the
    # upper one. The second pixel is never free, and is inpainted from the first.
    values, hidden = [10, 200, 200, 30, 200], [False, True, True, False, True]
    images = [np.full((1, 2, 3), value, np.uint8) for value in values]
    plate, known = masked_median(images, [np.array([[is_hidden, True]]) for is_hidden in hidden])
    assert plate[0].tolist() == [[30, 30, 30], [30, 30, 30]]
    assert known.tolist() == [[True, False]]


def test_an_edge_pixel_goes_to_the_side_that_covers_more_of_it() -> None:
    # A bright person from column 10 on; column 9 mixes: 60 % person in the upper half, 40 % in the lower. The
    # initial mask is a pixel too wide in the upper half, and right in the lower.
    plate, image = np.full((40, 20, 3), 50, np.uint8), np.full((40, 20, 3), 50, np.uint8)
    image[:, 10:] = 200
    image[:20, 9], image[20:, 9] = 140, 110
    mask = np.zeros((40, 20), bool)
    mask[:20, 8:], mask[20:, 10:] = True, True
    settled = refine_edge(mask, image, plate)
    assert (settled[2:18].argmax(1) == 9).all()
    assert (settled[22:38].argmax(1) == 10).all()


def test_movement_by_hand() -> None:
    def half(first: int) -> np.ndarray:
        return np.broadcast_to(np.arange(20) >= first, (30, 20))

    masks, moved = (Masks({("a", 0): encode(half(first))}, {}) for first in (10, 13))
    assert movement_px(masks, moved) == pytest.approx(3.0)
    assert movement_px(masks, Masks({("a", 1): encode(half(3))}, {})) == np.inf  # no view in common
    for full in ({("a", 1): encode(half(10))}, {("a", 1): encode(half(0))}):  # no edge, before or after
        others = {("a", 1): encode(half(0))}
        assert movement_px(Masks(masks.encoded | others, {}), Masks(moved.encoded | full, {})) == pytest.approx(3.0)


def test_components_of_another_person_are_removed() -> None:
    mask = np.zeros((10, 20), bool)
    mask[2:8, 2:6] = True  # 24 px, wholly within reach
    mask[2:8, 12:18] = True  # 36 px, 6 of them within reach
    reach = np.zeros_like(mask)
    reach[:, :13] = True
    kept = components_within(mask, reach)
    assert kept.sum() == 24
    assert kept[2:8, 2:6].all()


def test_segmentation_with_a_clean_plate_ignores_a_soft_shadow(tmp_path: Path) -> None:
    capture, truth = write_scene(tmp_path / "in")
    masks = segment(capture, None, SETTINGS)
    assert min(iou(masks.get(*view), mask) for view, mask in truth.items()) >= 0.97
    assert masks.report["cameras"]["c0"]["backend"] == "clean plate"
    (tmp_path / "out").mkdir()
    masks.save(tmp_path / "out")
    written = cv2.imread(str(tmp_path / "out" / "masks" / "c0" / "000003.png"), cv2.IMREAD_UNCHANGED)
    assert sorted(np.unique(written)) == [0, 255]
    loaded = Masks.load(tmp_path / "out")
    assert loaded.report == json.loads((tmp_path / "out" / "report.json").read_text())
    np.testing.assert_array_equal(loaded.get("c0", 3), masks.get("c0", 3))


def test_masks_made_in_parallel_are_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = only_frames(write_scene(tmp_path)[0], 3)
    encoded = {}
    for threads in (1, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        encoded[threads] = segment(capture, None, SETTINGS).encoded
    assert encoded[1] == encoded[3]


def test_given_masks_take_precedence_and_lose_other_people(tmp_path: Path) -> None:
    capture, truth = write_scene(tmp_path)
    given = {view: mask.copy() for view, mask in truth.items()}
    for mask in given.values():
        mask[150:250, 5:25] = True  # someone at the edge
    write_masks(capture, given)
    masks = segment(capture, None, SETTINGS)
    assert masks.report["cameras"]["c0"]["backend"] == "given"
    for view, mask in truth.items():
        np.testing.assert_array_equal(masks.get(*view), mask)


def test_a_given_mask_of_somebody_else_is_not_used(tmp_path: Path) -> None:
    """If the subject is known to be outside the image, the mask is emptied; if nothing is known, it is kept."""
    capture, truth = write_scene(tmp_path)
    write_masks(capture, truth)
    nowhere = np.zeros_like(truth["c0", 0])
    for height_px, believed in ((400.0, False), (0.0, True)):
        mask = given_mask(capture, "c0", 0, Prior(nowhere, nowhere, nowhere, nowhere, height_px))
        assert mask.any() == believed


def test_a_given_mask_loses_a_bystander_but_is_not_reduced_to_a_gap_beside_the_subject(tmp_path: Path) -> None:
    """The first mask shows only the subject's feet, and a bystander. The second is inverted: within reach, it shows a
    pixel as between an arm and the trunk."""
    capture, truth = write_scene(tmp_path)
    core, reach = np.zeros((2, *truth["c0", 0].shape), bool)
    core[4:20, 10:14], reach[2:28, 8:16] = True, True
    feet, bystander = np.zeros_like(core), np.zeros_like(core)
    feet[24:26, 11:13], bystander[4:26, 24:30] = True, True
    inverted = ~reach
    inverted[12, 9] = True
    write_masks(capture, truth | {("c0", 0): feet | bystander, ("c0", 1): inverted})
    for frame, expected in enumerate((feet, inverted)):
        mask = given_mask(capture, "c0", frame, Prior(core, core, reach, reach, height_px=24.0))
        np.testing.assert_array_equal(mask, expected)


def test_a_bad_mask_is_dropped_and_reported(tmp_path: Path) -> None:
    capture, truth = write_scene(tmp_path)
    write_masks(capture, truth | {("c0", 5): np.zeros_like(truth["c0", 5])})
    masks = segment(capture, None, SETTINGS)
    assert {frame for _, frame in masks.encoded} == {0, 1, 2, 3, 4, 6, 7}
    assert ("c0", 5) not in masks and ("c0", 6) in masks
    assert masks.report["cameras"]["c0"]["dropped"] == [{"frame": 5, "reason": "no person in the mask"}]


def test_a_camera_without_a_good_mask_is_an_error(tmp_path: Path) -> None:
    capture, truth = write_scene(tmp_path)
    write_masks(capture, {view: ~mask for view, mask in truth.items()})
    with pytest.raises(InputError, match=r"camera c0: no mask is usable.*inverted"):
        segment(capture, None, SETTINGS)


def test_another_person_next_to_the_subject_is_removed(tmp_path: Path) -> None:
    capture, truth = write_scene(tmp_path, stranger_px=130)
    capture = only_frames(capture, 3)
    masks = segment(capture, None, SETTINGS)
    views = product(capture.train_cameras, capture.frames)
    assert min(iou(masks.get(*view), truth[view]) for view in views) >= 0.97


def test_a_reflection_in_the_floor_is_removed(tmp_path: Path) -> None:
    capture, truth = write_scene(tmp_path, glossy=True)
    capture = only_frames(capture, 3)
    masks = segment(capture, None, SETTINGS)
    for view in product(capture.train_cameras, capture.frames):
        rows = np.flatnonzero(truth[view].any(1))
        below = masks.get(*view)[rows[-1] + round(0.1 * np.ptp(rows)) :]
        assert not below.any()


def test_a_missing_given_mask_names_the_file(tmp_path: Path) -> None:
    capture, truth = write_scene(tmp_path)
    del truth["c0", 2]
    write_masks(capture, truth)
    with pytest.raises(InputError, match=r"masks/c0/000002\.png: mask missing"):
        segment(capture, None, SETTINGS)


def test_a_plate_that_shows_the_person_is_an_error(tmp_path: Path) -> None:
    # The only image is the plate itself.
    capture, _ = write_scene(tmp_path, moves_m=0)
    (tmp_path / "background" / "c0.png").write_bytes((tmp_path / "images" / "c0" / "000000.png").read_bytes())
    with pytest.raises(InputError, match="no person in the mask"):
        segment(only_frames(capture, 1), None, SETTINGS)


def test_without_masks_or_a_plate_a_fitted_body_is_required(tmp_path: Path) -> None:
    capture, _ = write_scene(tmp_path, plate=False)
    with pytest.raises(InputError, match="fit a body first"):
        segment(capture, None, SETTINGS)


def test_without_a_plate_the_background_is_found_around_the_body(tmp_path: Path) -> None:
    capture, truth = write_scene(tmp_path, cameras=2, plate=False, moves_m=2.0)
    nowhere_m = torch.tensor([[[0.0, 0, -9], [0.01, 0, -9], [0, 0.01, -9]]]).expand(len(capture.frames), 3, 3)
    failed_fit = SimpleNamespace(  # keypoints must suffice
        vertices_m=lambda: nowhere_m, rig=SimpleNamespace(faces=torch.tensor([[0, 1, 2]])), index=capture.frames.index
    )
    masks = segment(capture, failed_fit, SETTINGS)  # type: ignore[arg-type]
    assert np.mean([iou(masks.get(*view), mask) for view, mask in truth.items()]) >= 0.95


@pytest.mark.parametrize("absent", [(0, 1), (4,), (6, 7)], ids=["comes late", "is away for a while", "leaves early"])
def test_without_a_plate_frames_in_which_nobody_is_detected_have_no_mask(
    tmp_path: Path, absent: tuple[int, ...]
) -> None:
    capture, truth = write_scene(tmp_path, cameras=2, moves_m=0.1)
    for camera, frame in product(capture.train_cameras, absent):
        write_image(tmp_path / "images" / camera / f"{frame:06d}.png", read_rgb(tmp_path / f"background/{camera}.png"))
        truth[camera, frame] = np.zeros_like(truth[camera, frame])
    shutil.rmtree(tmp_path / "background")
    write_likely(capture, truth)
    with edited_keypoints(tmp_path) as found:
        for keypoints in found.values():
            keypoints[list(absent)] = 0
    masks = segment(capture, None, SETTINGS)
    for camera in capture.train_cameras:
        dropped = masks.report["cameras"][camera]["dropped"]
        assert dropped == [{"frame": frame, "reason": "nobody is detected in this frame"} for frame in absent]
    assert sorted(masks.encoded) == sorted(view for view in truth if view[1] not in absent)


def test_rendered_capture_against_ground_truth(wave: Capture, tmp_path: Path) -> None:
    folder = shared_capture("valid-wave")
    capture = only_frames(Capture.load(shutil.copytree(wave.root, tmp_path / "copy")), 4)
    masks = segment(capture, None, SETTINGS)
    for camera, frame in product(capture.train_cameras, capture.frames):
        truth = cv2.imread(str(folder / "ground_truth" / "masks" / camera / f"{frame:06d}.png"), cv2.IMREAD_GRAYSCALE)
        assert iou(masks.get(camera, frame), truth > 127) > 0.95


@pytest.mark.parametrize("known_by", ["plate", "pose"])
def test_a_person_who_is_not_detected_keeps_the_mask_by_a_plate_or_a_given_pose(tmp_path: Path, known_by: str) -> None:
    """Nobody is detected in frame 4, which shows the person all the same."""
    capture, truth = write_scene(tmp_path, cameras=2, moves_m=0.1)
    with edited_keypoints(tmp_path) as found:
        for keypoints in found.values():
            keypoints[4] = 0
    write_likely(capture, truth)
    if known_by == "pose":
        shutil.rmtree(tmp_path / "background")
        poses = GivenPoses.unknown(len(capture.frames))
        poses.theta[:], poses.root[:] = 0, 0
        poses.save(tmp_path / "poses.npz")
    assert segment(capture, None, SETTINGS).encoded.keys() == truth.keys()


def test_a_mask_whose_area_jumps_is_dropped(tmp_path: Path) -> None:
    """In frame 4 the mask is 6 px wider on all sides, in the others it is right."""
    capture, truth = write_scene(tmp_path)
    leak = cv2.dilate(truth["c0", 4].astype(np.uint8), np.ones((13, 13), np.uint8)).astype(bool)
    write_masks(capture, truth | {("c0", 4): leak})
    masks = segment(capture, None, SETTINGS)
    (row,) = masks.report["cameras"]["c0"]["dropped"]
    assert row["frame"] == 4 and row["reason"].startswith("area jumps from ") and ("c0", 4) not in masks

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.capture import Capture, SubjectPoint, write_image
from hnerf.study.degradations.catalogue import Degradation
from hnerf.study.degradations.images import blur
from hnerf.study.degradations.occluder import person_middle, pillar
from tests.study.degradations.test_cameras import degraded
from tests.study.recording import SIZE_PX, write_recording


def test_noise_has_the_given_spread_in_training_cameras_only(tmp_path: Path) -> None:
    bad = degraded(tmp_path, "image_noise", 10)
    noise = np.stack([bad.image(name, frame).astype(float) - 100 - frame for name in ("01", "02") for frame in (2, 4)])
    assert noise.std() == pytest.approx(10, rel=0.1)  # 3072 values, through JPEG of quality 95
    assert np.ptp(bad.image("03", 2)) == 0
    plate = bad.background("01")
    assert plate is not None
    assert plate.std() == pytest.approx(10, rel=0.2)
    assert bad.given_mask("01", 2).sum() == 64  # type: ignore[union-attr]


def test_noise_leaves_detections_unchanged(tmp_path: Path) -> None:
    bad = degraded(tmp_path, "image_noise", 10)
    assert bad.has_person_masks
    good = Capture.load(tmp_path / "good")
    for name in bad.train_cameras:
        for read in (Capture.hands, Capture.landmarks):
            assert np.array_equal(read(bad, name), read(good, name))  # type: ignore[arg-type, operator]
        both = (one.person_probability(name, 10) for one in (bad, good))
        assert np.array_equal(*both)  # type: ignore[arg-type]


def test_blur_spreads_by_a_share_of_the_width(tmp_path: Path) -> None:
    good = write_recording(tmp_path / "good")
    dot = np.zeros((2 * SIZE_PX, SIZE_PX, 3), np.uint8)  # the height does not count
    dot[8, 8] = 255
    write_image(good.root / "images" / "01" / "000002.png", dot)
    blur(good, 6.25, np.random.default_rng(0), tmp_path / "bad")  # 1 px
    shown = Capture.load(tmp_path / "bad").image("01", 2)[..., 0].astype(int)
    # 255 / (2 pi) = 40.6 in the middle, times exp(-1 / 2) next to it, exp(-2) two pixels away; JPEG: a few levels off
    assert [shown[8, 8], shown[8, 9], shown[7, 8], shown[8, 10]] == pytest.approx([40.6, 24.6, 24.6, 5.5], abs=4)


def test_one_camera_gets_darker_and_one_brighter(tmp_path: Path) -> None:
    bad = degraded(tmp_path, "exposure", 1)
    assert sorted(int(bad.image(name, 2)[0, 0, 0]) for name in ("01", "02")) == [51, 204]  # 102 / 2, 102 x 2
    assert sorted(int(bad.background(name)[0, 0, 0]) for name in ("01", "02")) == [25, 100]  # type: ignore[index]
    assert bad.image("03", 2)[0, 0, 0] == 102


def test_halving_images_also_scales_cameras_masks_and_points(tmp_path: Path) -> None:
    bad = degraded(tmp_path, "small_images", 0.5)
    assert bad.image("01", 2).shape == (8, 8, 3)
    assert bad.image("03", 2).shape == (16, 16, 3)
    # Pixel centres at integers: x' = (x + 1/2) / 2 - 1/2.
    assert bad.cameras["01"].K.tolist() == [[8, 0, 3.5], [0, 8, 3.5], [0, 0, 1]]
    assert bad.keypoints("01")[0, 0, 1].tolist() == [0.75, 2.25, 1]  # type: ignore[index]
    assert bad.keypoints("03")[0, 0, 1].tolist() == [2, 5, 1]  # type: ignore[index]
    mask = bad.given_mask("01", 2)
    assert mask is not None
    assert np.argwhere(mask).min(0).tolist() == [2, 2]
    assert mask.sum() == 16
    assert bad.background("01").shape == (8, 8, 3)  # type: ignore[union-attr]
    assert bad.hands("01")[0, 1, 0].tolist() == [0.75, 2.25, 1]  # type: ignore[index]
    points_px, points_m = bad.landmarks("01")  # type: ignore[misc]
    assert points_px[0, 0, 0].tolist() == [0.75, 2.25, 1]
    assert points_m[0, 0, 0].tolist() == [0.2, 0.2, 0.2]
    likely = bad.person_probability("01", 2)
    assert likely is not None
    assert (255 * likely).round().sum() == 16 * 200 + 48 * 2


def test_the_middle_of_the_person_is_where_rays_meet(tmp_path: Path) -> None:
    """Expect (0, 0, 1), where both axes cross: the keypoints' mean is 0.1 px or so off the images' middle."""
    assert person_middle(write_recording(tmp_path)) == pytest.approx([0, 0, 1], abs=0.1)


def test_the_pillar_stands_between_the_person_and_the_camera(tmp_path: Path) -> None:
    camera = write_recording(tmp_path).cameras["01"]  # at (-4, 0, 1)
    corners_m = pillar(np.array([0.0, 0, 1]), camera, np.array([0.0, 0, 1]), 0.5)
    assert corners_m.min(0) == pytest.approx([-1.85, -0.25, -0.2])
    assert corners_m.max(0) == pytest.approx([-1.35, 0.25, 2.2])


def test_a_pillar_hides_pixels_masks_and_points_of_the_camera_behind_it(tmp_path: Path) -> None:
    """Its nearest side is 2.15 m from the camera, so at a focal length of 16 px, 0.5 m are 3.7 px. The other camera
    sees the pillar 1.35 m to the left of the person, not in front of them."""
    bad = degraded(tmp_path, "occluder", 0.5)
    grey = {name: (bad.image(name, 2).astype(int).max(-1) < 99).sum(0) for name in bad.cameras}  # rows per column
    behind = [name for name, columns in grey.items() if columns.any()]
    assert len(behind) == 1
    assert behind[0] in ("01", "02")
    assert np.flatnonzero(grey[behind[0]]).tolist() == [6, 7, 8, 9]
    mask, keypoints = bad.given_mask(behind[0], 2), bad.keypoints(behind[0])
    assert mask is not None
    assert keypoints is not None
    assert mask.sum() == 64 - 4 * 8
    assert not keypoints[0, 0, 0].any()  # 7.5 px
    assert keypoints[0, 0, 1].tolist() == [2, 5, 1]
    hands, likely = bad.hands(behind[0]), bad.person_probability(behind[0], 2)
    assert hands is not None
    assert likely is not None
    assert not hands[0, 0, 0].any()  # 7.5 px
    assert hands[0, 0, 1].tolist() == [2, 5, 1]
    assert np.flatnonzero(~likely.any(0)).tolist() == [6, 7, 8, 9]


@pytest.mark.parametrize(("kind", "strength"), [("large_images", 2), ("occluder", 1), ("camera_out_of_step", 2)])
@pytest.mark.parametrize("seed", [0, 1])  # draw different cameras
def test_a_subject_named_by_a_point_stays_the_subject(tmp_path: Path, kind: str, strength: float, seed: int) -> None:
    """Of two people who walk in a row, 1.6 m apart, the named one is where the other was two frames ago."""
    good = write_recording(tmp_path / "good")
    body_m = np.random.default_rng(0).normal((0, 0, 1), 0.2, (25, 3))
    walked_m = [
        [body_m + np.array([0.3 * k, 0.6 * k + behind, 0]) for behind in (0.4, -1.2)] for k in range(len(good.frames))
    ]
    seen = {name: camera.project(np.array(walked_m).reshape(-1, 3))[0] for name, camera in good.cameras.items()}
    people = {name: np.insert(px, 2, 1.0, -1).reshape(-1, 2, 25, 3) for name, px in seen.items()}
    np.savez(good.root / "keypoints.npz", **people)  # type: ignore[arg-type]
    named = SubjectPoint(tuple(people["01"][2, 1, 8, :2]), "01", good.frames[2])
    good = dataclasses.replace(good, subject_point=named)
    Degradation(kind=kind, strength=strength, seed=seed).apply(good, out=tmp_path / "bad")
    point = Capture.load(tmp_path / "bad").subject_point
    assert point is not None
    shown = Capture.load(tmp_path / "bad").keypoints(point.camera)[good.frames.index(point.frame)]  # type: ignore[index]
    off_px = np.where(shown[..., 2] > 0, np.linalg.norm(shown[..., :2] - point.at, axis=-1), np.inf).min(1)
    assert off_px[1] == pytest.approx(0, abs=1e-6) and off_px[0] > 0.1


@pytest.mark.parametrize(
    ("kind", "strength", "kept"),
    [("image_blur", 1, True), ("camera_out_of_step", 1, True), ("small_images", 0.5, False)],
)
def test_board_footage_stays_unless_images_change_size(tmp_path: Path, kind: str, strength: float, kept: bool) -> None:
    good = write_recording(tmp_path / "good")
    (good.root / "boards.npz").write_bytes(b"corners")
    Degradation(kind=kind, strength=strength, seed=0).apply(good, out=tmp_path / "bad")
    assert (tmp_path / "bad" / "boards.npz").exists() is kept

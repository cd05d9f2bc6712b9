from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.capture import Capture
from hnerf.errors import InputError, NotApplicableError
from hnerf.study.degradations.catalogue import KINDS, Degradation, check_strengths
from tests.study.recording import FRAMES, write_detected, write_recording


def degraded(tmp_path: Path, kind: str, strength: float, seed: int = 0) -> Capture:
    """Degrade the recording of tests/study/recording.py and load it."""
    capture = write_recording(tmp_path / "good")
    write_detected(capture)
    Degradation(kind=kind, strength=strength, seed=seed).apply(capture, out=tmp_path / "bad")
    return Capture.load(tmp_path / "bad")


def test_the_given_number_of_cameras_or_frames_is_left(tmp_path: Path) -> None:
    one = degraded(tmp_path / "a", "cameras_left", 1)
    assert (len(one.train_cameras), one.test_cameras) == (1, ("03",))
    two = degraded(tmp_path / "b", "frames_left", 2)
    assert len(two.train_frames) == 2
    assert set(two.train_frames) < {2, 4, 6}
    assert two.novel_pose_frames == (8, 10)


def test_keeping_all_cameras_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="ada: has only 2 training cameras; keep fewer than that"):
        degraded(tmp_path, "cameras_left", 2)


@pytest.mark.parametrize("kind", ["camera_turned", "camera_out_of_step", "exposure"])
def test_a_single_camera_cannot_be_made_different_from_others(tmp_path: Path, kind: str) -> None:
    """Turning, delaying or darkening the only camera would change the world itself, and scores would count that
    against the avatar."""
    capture = write_recording(tmp_path / "good")
    alone = replace(capture, train_cameras=capture.train_cameras[:1])
    with pytest.raises(NotApplicableError, match="ada: has only one training camera; this needs several"):
        Degradation(kind=kind, strength=1.0, seed=0).apply(alone, out=tmp_path / "bad")


def test_one_training_camera_turns_about_its_centre(tmp_path: Path) -> None:
    good, bad = write_recording(tmp_path / "same"), degraded(tmp_path, "camera_turned", 2.0)
    angles_deg = {}
    for name, camera in bad.cameras.items():
        turn = camera.R @ good.cameras[name].R.T
        angles_deg[name] = np.rad2deg(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
        assert camera.centre_m == pytest.approx(good.cameras[name].centre_m, abs=1e-12)
    assert sorted(round(angle, 4) for angle in angles_deg.values()) == [0.0, 0.0, 2.0]
    assert angles_deg["03"] == 0


def test_a_late_camera_shows_its_earlier_frames(tmp_path: Path) -> None:
    bad = degraded(tmp_path, "camera_out_of_step", 2)
    shown = {name: [int(bad.image(name, frame)[0, 0, 0]) for frame in FRAMES] for name in bad.cameras}
    late = [name for name, values in shown.items() if values != [102, 104, 106, 108, 110]]
    assert len(late) == 1
    assert late[0] != "03"
    assert shown[late[0]] == [102, 102, 102, 104, 106]
    keypoints = {name: bad.keypoints(name)[:, 0, 1, 0].tolist() for name in bad.cameras}  # type: ignore[index]
    assert keypoints.pop(late[0]) == [2, 2, 2, 4, 6]
    assert list(keypoints.values()) == [[2, 4, 6, 8, 10]] * 2
    for name in bad.train_cameras:
        expected = [2, 2, 2, 4, 6] if name == late[0] else [2, 4, 6, 8, 10]
        assert bad.hands(name)[:, 1, 0, 0].tolist() == expected  # type: ignore[index]
        points_px, points_m = bad.landmarks(name)  # type: ignore[misc]
        assert points_px[:, 0, 0, 0].tolist() == expected
        assert (10 * points_m[:, 0, 0, 0]).tolist() == pytest.approx(expected)
        likely = [bad.person_probability(name, frame) for frame in FRAMES]
        assert [round(255 * float(mask[0, 0])) for mask in likely] == expected  # type: ignore[index]


def test_a_late_camera_has_masks_only_of_earlier_frames_with_masks(tmp_path: Path) -> None:
    capture = write_recording(tmp_path / "good")
    for name in capture.train_cameras:
        (capture.root / "masks" / name / "000004.png").unlink()
    Degradation(kind="camera_out_of_step", strength=1.0, seed=0).apply(capture, out=tmp_path / "bad")
    masked = [[path.stem for path in sorted((tmp_path / "bad" / "masks" / name).iterdir())] for name in ("01", "02")]
    assert sorted(masked) == [["000002", "000004", "000008", "000010"], ["000002", "000006", "000008", "000010"]]


@pytest.mark.parametrize("frames", [0.4, 5])
def test_a_delay_that_no_frame_can_show_is_not_applicable(tmp_path: Path, frames: float) -> None:
    with pytest.raises(NotApplicableError, match=f"ada: has 5 frames; none can be delayed by {frames:g}"):
        degraded(tmp_path, "camera_out_of_step", frames)


def test_seeds_are_repeatable_and_differ(tmp_path: Path) -> None:
    cameras = [degraded(tmp_path / f"{k}", "camera_turned", 1, seed).cameras for k, seed in enumerate((0, 0, 1))]
    turns = [np.stack([camera.R for camera in rig.values()]) for rig in cameras]
    assert np.array_equal(turns[0], turns[1])
    assert not np.allclose(turns[0], turns[2])


@pytest.mark.parametrize("strengths", [(), (1.0, 3.0, 2.0), (1.0, 1.0), (0.0, 1.0), (float("nan"),), (float("inf"),)])
def test_strengths_must_rise_within_bounds(strengths: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="mask_holes: give numbers between 0 and 100 that rise, the mildest first"):
        check_strengths("mask_holes", strengths)


@pytest.mark.parametrize(
    ("kind", "strengths", "expected"),
    [
        ("cameras_left", (1, 2, 3), "whole numbers between 1 and inf that fall"),
        ("cameras_left", (0.5,), "whole numbers between 1 and inf that fall"),
        ("frames_left", (2.5, 1), "whole numbers between 1 and inf that fall"),
        ("camera_out_of_step", (0.4,), "whole numbers between 0 and inf that rise"),
        ("small_images", (0.1, 0.5), "numbers between 0 and 1 that fall"),
        ("small_images", (1.5, 0.5), "numbers between 0 and 1 that fall"),
        ("large_images", (0.9, 0.5), "numbers between 1 and inf that rise"),
        ("learning_rate_down", (0.03, 0.5), "numbers between 0 and 1 that fall"),
        ("learning_rate_up", (1, 3), "numbers between 1 and inf that rise"),
        ("mask_limb", (50, 120), "numbers between 0 and 100 that rise"),
    ],
)
def test_each_kind_has_its_own_direction_and_bounds(kind: str, strengths: tuple[float, ...], expected: str) -> None:
    with pytest.raises(InputError, match=f"degradation {kind}: give {expected}, the mildest first"):
        check_strengths(kind, strengths)


def test_reachable_bounds_are_accepted_as_strengths() -> None:
    check_strengths("cameras_left", (3, 2, 1))
    check_strengths("mask_limb", (10, 100))


def test_kinds_have_different_labels() -> None:
    labels = [kind.label for kind in KINDS.values()]
    assert len(set(labels)) == len(labels)


def test_unknown_degradations_are_refused() -> None:
    with pytest.raises(InputError, match="degradation hair: no such degradation; there are cameras_left, "):
        check_strengths("hair", (1.0,))

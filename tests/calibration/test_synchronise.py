import dataclasses
from pathlib import Path

import numpy as np
import pytest

from hnerf.calibration import synchronise as synchronise_module
from hnerf.calibration.calibrated import load_cameras
from hnerf.calibration.check import check_calibration
from hnerf.calibration.synchronise import measure_timing, synchronise, synchronise_capture
from hnerf.capture.capture import Capture
from hnerf.config import CalibrationSettings
from hnerf.errors import InputError
from tests.calibration.synthetic import STANDING_M, ring, turned, write_capture

SETTINGS = CalibrationSettings()
FRAMES = 48


def poses_m(instants: np.ndarray) -> np.ndarray:
    """Return joints (n, 25, 3) of the figure moving to and fro with swinging arms.

    On a circle at constant speed, an offset in time would look like a rotation of the world, i.e. a moved camera.
    """
    poses = np.repeat(STANDING_M[None], len(instants), axis=0)
    poses[:, [3, 4, 6, 7], 0] += 0.2 * np.sin(instants / 5)[:, None] * np.array([1, 1, -1, -1])
    poses[:, :, 0] += 0.5 * np.sin(instants / 7)[:, None]
    poses[:, :, 1] += 0.3 * np.sin(instants / 4)[:, None]
    return poses


def recorded(offsets: dict[str, float], frames: int = FRAMES, noise_px: float = 2, speed: float = 1) -> np.ndarray:
    """Return keypoints (4, frames, 25, 3) recorded by the ring. A camera's frame f + offset shows the instant f, so its
    frame f shows the instant f - offset."""
    rng, seen = np.random.default_rng(1), []
    for camera in ring(4):
        uv = camera.project(poses_m(speed * (np.arange(frames) - offsets.get(camera.name, 0.0))))[0]
        seen.append(np.concatenate([uv + noise_px * rng.normal(size=uv.shape), np.full_like(uv[..., :1], 0.8)], -1))
    return np.stack(seen)


def capture_of(root: Path, keypoints: np.ndarray, frames: tuple[int, ...] | None = None) -> Capture:
    capture = write_capture(root, ring(4), keypoints)
    return capture if frames is None else dataclasses.replace(capture, train_frames=frames)


@pytest.mark.parametrize(("name", "offset"), [("c0", 3.0), ("c1", -2.3), ("c2", 0.5), ("c3", -0.3)])
def test_one_unsynchronised_camera_is_found(name: str, offset: float) -> None:
    offsets, held_out_px, notes = synchronise(ring(4), recorded({name: offset}), range(FRAMES), SETTINGS)
    assert offsets == {name: pytest.approx(offset, abs=0.08)}
    assert min(held_out_px, key=held_out_px.__getitem__).startswith(f"camera {name} shifted by")
    assert not notes


def test_several_unsynchronised_cameras_are_found() -> None:
    offsets, _, _ = synchronise(ring(4), recorded({"c0": 2.0, "c3": -1.4}), range(FRAMES), SETTINGS)
    assert offsets == {"c0": pytest.approx(2, abs=0.1), "c3": pytest.approx(-1.4, abs=0.1)}


def test_synchronised_cameras_get_no_offset() -> None:
    keypoints = recorded({})
    assert synchronise(ring(4), keypoints, range(FRAMES), SETTINGS) == ({}, {}, [])
    for timing in measure_timing(ring(4), keypoints, range(FRAMES)).values():
        assert not timing.reason
        assert abs(timing.offset_frames) < 4 * timing.error_frames < 0.25


def test_a_turned_camera_gets_no_offset() -> None:
    # A degree is 17 px, about as far as the figure moves in one frame.
    cameras = [turned(camera, 1.0) if camera.name == "c1" else camera for camera in ring(4)]
    assert synchronise(cameras, recorded({}), range(FRAMES), SETTINGS)[0] == {}


def test_no_offset_is_measured_if_the_person_hardly_moves() -> None:
    # At a hundredth of walking speed, the person moves less than a pixel per frame; two frames are less than the noise.
    keypoints = recorded({"c1": 2.0}, speed=0.01)
    assert synchronise(ring(4), keypoints, range(FRAMES), SETTINGS)[0] == {}
    reasons = [timing.reason for timing in measure_timing(ring(4), keypoints, range(FRAMES)).values()]
    assert all(reasons)
    assert any("too little motion" in reason for reason in reasons)


def test_a_camera_that_shows_the_person_in_less_than_half_of_the_frames_has_too_few() -> None:
    keypoints = recorded({})
    keypoints[2, 20:, :, 2] = 0
    assert measure_timing(ring(4), keypoints, range(FRAMES))["c2"].reason == "fewer than 24 frames in common"


def test_two_cameras_cannot_measure_offsets() -> None:
    found = measure_timing(ring(4)[:2], recorded({})[:2], range(FRAMES))
    assert {timing.reason for timing in found.values()} == {"it takes two other cameras to place keypoints"}


def test_an_offset_is_corrected_and_reported(tmp_path: Path, no_pictures: None) -> None:
    capture = capture_of(tmp_path / "in", recorded({"c2": 2.0}))
    report = check_calibration(capture, SETTINGS)
    assert [verdict.status for verdict in report.verdicts.values()] == ["ok", "ok", "refined", "ok"]
    assert report.verdicts["c2"].frame_offset == pytest.approx(2, abs=0.08)
    assert any(reason.startswith("out of step by +2.0") for reason in report.verdicts["c2"].reasons)
    assert "2 frames dropped that not every camera recorded: 46, 47" in report.notes
    report.save(tmp_path / "out")
    used = load_cameras(tmp_path / "out", capture)
    assert used.frames == tuple(range(46))
    found, given = used.keypoints("c2"), capture.keypoints("c2")
    assert found is not None and given is not None
    # Frame 5 of the other cameras is frame 7 of this one, to within a few hundredths.
    assert np.abs(found[5] - given[7]).max() < 2


def test_an_offset_of_unknown_error_is_reported_without_one(tmp_path: Path, no_pictures: None) -> None:
    """Nine of twelve frames are left, too few to measure the remaining offset."""
    report = check_calibration(capture_of(tmp_path, recorded({"c2": 3.0}, frames=12, speed=2)), SETTINGS)
    assert np.isnan(report.verdicts["c2"].timing.error_frames)
    stated = next(reason for reason in report.verdicts["c2"].reasons if reason.startswith("out of step"))
    assert stated == f"out of step by {report.verdicts['c2'].frame_offset:+.2f} frames: corrected"


def test_unsynchronised_strided_frames_are_refused_with_what_to_cut(tmp_path: Path, no_pictures: None) -> None:
    strided = recorded({"c0": -2.0, "c1": 0.0}, frames=4 * FRAMES)[:, ::4]
    capture = capture_of(tmp_path, strided, frames=tuple(range(0, 4 * FRAMES, 4)))
    with pytest.raises(InputError) as caught:
        check_calibration(capture, SETTINGS)
    assert "camera c0 by -2." in str(caught.value) and "run `hnerf synchronise`, " in str(caught.value)
    assert "2 from camera c1, 2 from camera c2, 2 from camera c3" in str(caught.value)


def test_strided_frames_with_an_offset_below_one_frame_are_kept(tmp_path: Path, no_pictures: None) -> None:
    """Keypoints are synchronised; of the ingested frames, each camera shows the image closest to the instant."""
    strided = recorded({"c0": 0.8}, frames=4 * FRAMES, noise_px=0.5, speed=0.5)[:, ::4]
    capture = capture_of(tmp_path / "in", strided, frames=tuple(range(0, 4 * FRAMES, 4)))
    report = check_calibration(capture, SETTINGS)
    assert report.verdicts["c0"].frame_offset == pytest.approx(0.8, abs=0.1)
    assert any("images of camera c0 are -0.8" in note for note in report.notes)
    report.save(tmp_path / "out")
    used = load_cameras(tmp_path / "out", capture)
    assert used.frames == capture.frames
    assert [used.recorded_frame("c0", frame) for frame in used.frames] == list(used.frames)
    found, given = used.keypoints("c0"), capture.keypoints("c0")
    assert found is not None and given is not None
    assert np.abs(found[5] - (0.8 * given[5] + 0.2 * given[6])).max() < 2


def test_offsets_are_in_recorded_frames_if_images_are_numbered_in_fives(
    tmp_path: Path, no_pictures: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With images numbered 0, 5, 10, ..., an offset of 2 is 0.4 of the interval between images."""
    numbers = tuple(range(0, 5 * FRAMES, 5))
    capture = dataclasses.replace(capture_of(tmp_path, recorded({}), frames=numbers), frame_step=5)
    monkeypatch.setattr(synchronise_module, "synchronise", lambda *_: ({"c1": 2.0}, {}, []))
    synchronised, _, notes = synchronise_capture(capture, ring(4), recorded({}), SETTINGS)
    assert synchronised.frames == numbers
    assert not notes
    monkeypatch.setattr(synchronise_module, "synchronise", lambda *_: ({"c1": 125.0}, {}, []))
    with pytest.raises(InputError, match=r"by \+125.00 frames; .* recordings: 25 from camera c1"):
        synchronise_capture(capture, ring(4), recorded({}), SETTINGS)


def test_offsets_allow_for_gaps_in_frame_numbers() -> None:
    # Frames 16 to 23 were never ingested: neighbours in the array are not neighbours in time.
    frames = [frame for frame in range(FRAMES) if not 16 <= frame < 24]
    offsets, _, _ = synchronise(ring(4), recorded({"c1": 1.0})[:, frames], frames, SETTINGS)
    assert offsets == {"c1": pytest.approx(1, abs=0.08)}

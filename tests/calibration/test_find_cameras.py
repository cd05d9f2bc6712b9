"""Clocks and cameras of recordings without calibration."""

import dataclasses
import logging
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from flows import preparation
from flows.preparation import ingest_recording, missing_cameras
from hnerf.calibration import find_cameras as module
from hnerf.calibration.bundle import align
from hnerf.calibration.clocks.estimate import Clocks
from hnerf.calibration.clocks.recording import UndeterminedClocksError
from hnerf.calibration.find_cameras import find_missing_cameras, have_equal_frames
from hnerf.calibration.person.recording import calibrate_recording
from hnerf.calibration.silhouettes import Outlines
from hnerf.capture.capture import Capture
from hnerf.capture.clocks import Clock, read_clocks, write_clocks
from hnerf.capture.formats.easymocap import write_easymocap
from hnerf.capture.formats.from_person import FromPerson
from hnerf.capture.ingest import ingest
from hnerf.capture.lens import pinhole
from hnerf.config import CaptureSettings, load_settings
from hnerf.errors import InputError
from tasks.source import read_capture
from tasks.store import Store
from tests.calibration.person.test_recording import in_this_process, write_recording
from tests.calibration.synthetic import detections, ring
from tests.capture.recordings import write_video

CLOCKS = {"a": Clock(0.0), "b": Clock(1.25, 1.0001)}
MOVES_TOO_LITTLE = UndeterminedClocksError("film: no start offset is clearly better")


@pytest.fixture
def calibrated_with(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Replace calibration by a fake, and return the clocks that it gets."""
    given, found = list[Any](), Mock()
    monkeypatch.setattr(module, "calibrate_recording", lambda _, clocks: given.append(clocks) or found)
    return given


def film(folder: Path, *frames: int) -> Path:
    for name, count in zip("ab", frames, strict=True):
        write_video(folder / "videos" / f"{name}.mp4", count)
    return folder


def test_a_recording_without_calibration_is_ingested_with_cameras_from_the_person(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images of the same number are simultaneous: no clocks are looked for."""
    caged = Mock(side_effect=in_this_process)
    monkeypatch.setattr("tasks.cage.run_caged", caged)
    monkeypatch.setattr(module, "synchronise_recording", Mock(side_effect=AssertionError))
    monkeypatch.setattr(Outlines, "of", lambda *_: None)
    truth = ring(3)
    seen = {camera.name: found for camera, found in zip(truth, detections(truth, 1.0), strict=True)}
    folder = write_recording(tmp_path / "film", seen)
    fov_deg = np.rad2deg(2 * np.arctan(0.5))  # a focal length of 1000 px
    (folder / "capture.toml").write_text(f"stature_m = 1.8\nfield_of_view_deg = {fov_deg}\n")
    source, _ = read_capture(folder)
    capture = Capture.load(ingest_recording(Store(tmp_path / "store"), source, load_settings("fast")).root)
    found = align([capture.cameras[camera.name] for camera in truth], truth)
    assert max(np.linalg.norm(a.centre_m - b.centre_m) for a, b in zip(found, truth, strict=True)) < 0.03
    assert capture.notes[0].startswith(
        "no calibration, so cameras were found from the person; scale: a person of 1.80 m"
    )
    assert capture.notes[1:] == ("cameras are taken to be in step",)
    assert caged.call_count == 2  # cameras, capture
    made = {path.name for path in (tmp_path / "store" / "cameras").glob("*/*")}
    assert made == {"intri.yml", "extri.yml", "report.json"}


def test_cameras_are_found_again_once_the_sound_of_videos_can_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever ffmpeg is installed."""

    def find(source: Any, read: Any, root: Path, out: Path) -> None:
        (out / "report.json").write_text('{"cameras": {"a": {"median_px": 1.0}}}')

    monkeypatch.setattr("tasks.cameras.read_source", find)
    (source, _), store, found = read_capture(film(tmp_path / "film", 3, 4)), Store(tmp_path / "store"), []
    for program in (None, "/usr/bin/ffmpeg", "/opt/bin/ffmpeg"):
        monkeypatch.setattr(preparation, "which", lambda _, program=program: program)
        found.append(missing_cameras(store, source))
    assert found[0] != found[1] == found[2]


def test_clocks_of_videos_are_found_and_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calibrated_with: list[Any]
) -> None:
    monkeypatch.setattr(module, "synchronise_recording", lambda _: (Clocks(CLOCKS, {}, {}), {}))
    find_missing_cameras(film(tmp_path / "film", 3, 4), tmp_path / "out")
    assert calibrated_with == [CLOCKS] and read_clocks(tmp_path / "out") == CLOCKS


def test_clocks_in_the_folder_are_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calibrated_with: list[Any]
) -> None:
    monkeypatch.setattr(module, "synchronise_recording", Mock(side_effect=AssertionError))
    folder = film(tmp_path / "film", 3, 4)
    (folder / "clocks.toml").write_text("[a]\n[b]\noffset_s = 0.04\n")
    find_missing_cameras(folder, tmp_path / "out")
    assert calibrated_with == [{"a": Clock(), "b": Clock(0.04)}] == [read_clocks(tmp_path / "out")]


def test_if_clocks_cannot_be_found_videos_with_the_same_frames_are_in_step(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    calibrated_with: list[Any],
) -> None:
    monkeypatch.setattr(module, "synchronise_recording", Mock(side_effect=MOVES_TOO_LITTLE))
    with caplog.at_level(logging.WARNING):
        find_missing_cameras(film(tmp_path / "film", 3, 3), tmp_path / "out")
    assert calibrated_with == [{}] and not (tmp_path / "out" / "clocks.toml").exists()
    assert "no start offset is clearly better; cameras are taken to be in step" in caplog.text
    with pytest.raises(InputError, match=r"clearly better; or state the clocks in clocks\.toml"):
        find_missing_cameras(film(tmp_path / "other", 3, 4), tmp_path / "out")


def test_the_calibration_sees_the_videos_in_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Camera b started two frames earlier: of 8 and 9 frames, 7 are common."""
    captures: list[Capture] = []
    monkeypatch.setattr("hnerf.calibration.person.recording.with_keypoints", lambda capture, _: capture)
    monkeypatch.setattr("hnerf.calibration.person.recording.calibrate_from_person",
                        lambda capture, *_: captures.append(capture) or Mock(lenses=[]))  # fmt: skip
    monkeypatch.setattr("hnerf.calibration.person.recording.dataclasses", Mock())
    calibrate_recording(film(tmp_path / "film", 8, 9), clocks={"a": Clock(), "b": Clock(0.08)})
    assert captures[0].frames == tuple(range(7))


def test_the_capture_is_ingested_in_step_by_the_clocks_that_were_found(tmp_path: Path) -> None:
    folder, found = film(tmp_path / "film", 8, 9), tmp_path / "found"
    found.mkdir()
    write_easymocap(
        found, [dataclasses.replace(pinhole(c), name=n, size_px=(64, 48)) for n, c in zip("ab", ring(2), strict=True)]
    )
    write_clocks(found / "clocks.toml", {"a": Clock(), "b": Clock(0.08)})
    (found / "report.json").write_text('{"notes": ["scale: 1 %"]}')
    capture = ingest(folder, CaptureSettings(), tmp_path / "out", FromPerson(folder, found))
    assert capture.frames == tuple(range(7))
    assert capture.notes[1] == "images are matched by these clocks: a +0.000 s, b +0.080 s"
    assert Capture.load(tmp_path / "out").notes == capture.notes


def test_other_faults_are_not_taken_for_undetermined_clocks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calibrated_with: list[Any]
) -> None:
    monkeypatch.setattr(module, "synchronise_recording", Mock(side_effect=InputError("b.mp4: cannot be decoded")))
    with pytest.raises(InputError, match=r"^b\.mp4: cannot be decoded$"):
        find_missing_cameras(film(tmp_path / "film", 3, 3), tmp_path / "out")
    assert not calibrated_with


def test_a_point_in_a_video_needs_clocks(tmp_path: Path, calibrated_with: list[Any]) -> None:
    """The same frame number would be the camera's own at first, and later an instant of the slowest camera."""
    folder = film(tmp_path / "film", 8, 9)
    (folder / "capture.toml").write_text('subject = "nearest to (5, 5) in b at frame 3"\n')
    with pytest.raises(InputError, match=r"capture\.toml: subject: .* run `hnerf synchronise"):
        find_missing_cameras(folder, tmp_path / "out")
    (folder / "clocks.toml").write_text("[a]\n[b]\n")
    find_missing_cameras(folder, tmp_path / "out")
    assert calibrated_with == [{"a": Clock(), "b": Clock()}]


@pytest.mark.parametrize(
    ("toml", "refused"),
    [
        ('up = "y"', "up: without a calibration, Z is up; remove the line"),
        ('units = "mm"', "units: cameras found from the person are in metres; remove the line"),
        ('[cameras]\ntrain = ["a", "b", "c"]', r"camera c is not in the folder; correct \[cameras\]"),
    ],
)
def test_what_ingestion_would_refuse_is_refused_before_cameras_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calibrated_with: list[Any], toml: str, refused: str
) -> None:
    """Finding them takes minutes, and again after `capture.toml` is corrected."""
    monkeypatch.setattr(module, "synchronise_recording", Mock(side_effect=AssertionError))
    folder = film(tmp_path / "film", 3, 3)
    (folder / "capture.toml").write_text(toml)
    with pytest.raises(InputError, match=rf"capture\.toml: {refused}$"):
        find_missing_cameras(folder, tmp_path / "out")
    assert not calibrated_with


def test_ground_truth_is_refused_without_a_calibration(tmp_path: Path) -> None:
    folder = film(tmp_path / "film", 3, 3)
    (folder / "ground_truth").mkdir()
    source, _ = read_capture(folder)
    with pytest.raises(InputError, match="ground_truth: of no use without a calibration"):
        ingest_recording(Store(tmp_path / "store"), source, load_settings("fast"))


def test_frame_rates_that_ingestion_takes_for_equal_are_equal(tmp_path: Path) -> None:
    for name, fps in (("a", 29.97), ("b", 30.0)):
        write_video(tmp_path / f"{name}.mp4", 3, fps=fps)
    assert have_equal_frames(tmp_path)
    write_video(tmp_path / "b.mp4", 3, fps=31)
    assert not have_equal_frames(tmp_path)

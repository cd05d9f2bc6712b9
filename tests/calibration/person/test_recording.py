"""The commands that make calibration files and clocks from a folder of images and keypoint files."""

import json
import logging
import shutil
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image

from flows.cli import main
from hnerf.calibration.bundle import align
from hnerf.calibration.clocks import recording
from hnerf.calibration.clocks.recording import _track, synchronise_recording
from hnerf.calibration.silhouettes import Outlines
from hnerf.capture.capture import write_image
from hnerf.capture.clocks import read_clocks
from hnerf.capture.formats.easymocap import EasyMocap, write_easymocap
from hnerf.capture.formats.pose2sim import Pose2Sim
from hnerf.capture.ingest import ingest
from hnerf.capture.lens import Lens, pinhole
from hnerf.capture.uncalibrated import Uncalibrated
from hnerf.config import CaptureSettings
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera
from tests.calibration.clocks.test_clocks import filmed
from tests.calibration.synthetic import detections, ring
from tests.capture import recordings as rec

FRAMES = 12


def write_recording(
    folder: Path, keypoints: dict[str, np.ndarray], pose2sim: bool = False, side_px: int = 1000
) -> Path:
    """Write grey square images, and keypoints (frames, 25, 3) by camera as OpenPose files."""
    for name, frames in keypoints.items():
        place = folder / (f"pose/{name}_json" if pose2sim else f"openpose/{name}")
        pictures = folder / "images" / name
        pictures.mkdir(parents=True)
        grey = Image.new("RGB", (side_px, side_px), (90, 90, 90))
        for frame, points in enumerate(frames):
            grey.save(pictures / f"{frame:06d}.jpg", quality=20)
            rec.write_keypoints(place / f"{frame:06d}_keypoints.json", [points])
    return folder


def in_this_process(read: Callable[..., None], *arguments: object, folder: Path) -> None:
    """Read like `run_caged`, but in this process."""
    read(*arguments)


@pytest.mark.parametrize("pose2sim", [False, True])
def test_the_command_calibrates_a_folder_from_the_person(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, pose2sim: bool
) -> None:
    monkeypatch.setattr("tasks.cage.run_caged", in_this_process)
    monkeypatch.setattr("hnerf.calibration.person.calibrate.FRAMES", 2)
    if pose2sim:  # the other case looks for outlines
        monkeypatch.setattr(Outlines, "of", lambda *_: None)
    truth = ring(3)
    seen = {camera.name: found for camera, found in zip(truth, detections(truth, 1.0), strict=True)}
    folder, out = write_recording(tmp_path / "film", seen, pose2sim), tmp_path / "cameras"
    fov_deg = str(2 * np.rad2deg(np.arctan(0.5)))  # a focal length of 1000 px
    command = ["calibrate", str(folder), "--from", "person", "--height", "1.8", "--fov", fov_deg, "--out", str(out)]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "a person of 1.80 m" in printed and f"cameras: {out}; copy its files into {folder} to use them\n" in printed
    lenses = (Pose2Sim(out) if pose2sim else EasyMocap(out)).lenses()
    found = align([Camera(c.name, lenses[c.name].K, lenses[c.name].R, lenses[c.name].t_m, 1, 1) for c in truth], truth)
    assert max(np.linalg.norm(a.centre_m - b.centre_m) for a, b in zip(found, truth, strict=True)) < 0.03
    assert json.loads((out / "report.json").read_text())["cameras"]["c0"]["uncertainty"]["move_m"] < 0.1
    shutil.copytree(out, folder, dirs_exist_ok=True)  # what the command says to do to use the cameras
    assert ingest(folder, CaptureSettings(), tmp_path / "ingested").has_keypoints
    again = Uncalibrated(folder, fov_deg=float(fov_deg))  # the same command does the same again
    assert {known.source for known in again.known_lenses.values()} == {"53.1301 degrees given"}


def test_a_field_of_view_is_refused_if_all_lenses_are_known(tmp_path: Path) -> None:
    """If calibrated cameras were copied into the folder, their lenses would be used instead."""
    folder = write_recording(tmp_path / "film", {"c0": np.ones((1, 25, 3)), "c1": np.ones((1, 25, 3))})
    write_easymocap(folder, [pinhole(camera) for camera in ring(2)])
    with pytest.raises(InputError, match=r"intri\.yml: has the lenses of all cameras; remove --fov"):
        _ = Uncalibrated(folder, fov_deg=60.0).known_lenses
    write_easymocap(folder, [pinhole(camera) for camera in ring(1)])
    assert Uncalibrated(folder, fov_deg=60.0).known_lenses["c1"].source == "60 degrees given"


def test_the_command_synchronises_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_recording(tmp_path / "film", {f"c{i}": filmed(i, 3.0, 0.5 * i).keypoints for i in range(2)})
    assert main(["synchronise", str(folder)]) == 0
    assert read_clocks(folder)["c1"].offset_s == pytest.approx(0.5, abs=0.1 / 30)
    assert main(["synchronise", str(folder)]) == 2
    assert "remove it to synchronise again" in capsys.readouterr().err


def test_recordings_of_another_size_than_the_calibration_are_not_synchronised(tmp_path: Path) -> None:
    folder = rec.write_pose2sim(tmp_path / "film")
    calibration = folder / "calibration" / "Calib.toml"
    calibration.write_text(calibration.read_text().replace("[64.0, 48.0]", "[128.0, 96.0]"))
    with pytest.raises(InputError, match=r"cam01\.mp4: is 64 x 48 px, but camera cam01 was calibrated at 128 x 96"):
        synchronise_recording(folder)


def test_cameras_recorded_in_black_bars_are_synchronised_with_the_lens_of_what_the_bars_enclose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """8 px of bars above and below a picture of 64 x 48 px, whose middle row is 23.5."""
    folder = rec.write_pose2sim(tmp_path / "film")
    for video in (folder / "videos").iterdir():
        video.unlink()
        barred = np.pad(np.full((48, 64, 3), 120, np.uint8), ((8, 8), (0, 0), (0, 0)))
        (folder / "images" / video.stem).mkdir(parents=True)
        for frame in range(10):
            Image.fromarray(barred).save(folder / "images" / video.stem / f"{frame:06d}.png")
    (folder / "videos").rmdir()
    used: dict[str, Camera] = {}
    monkeypatch.setattr(recording, "_track", lambda *_: None)
    monkeypatch.setattr(recording, "estimate_clocks", lambda _, cameras, __: used.update(cameras))
    synchronise_recording(folder)
    assert [camera.K[1, 2] for camera in used.values()] == pytest.approx([31.5, 31.5], abs=0.1)


@pytest.mark.parametrize(
    ("old", "new", "warning"),
    [
        ("matrix =", "matrices =", "Calib.toml: camera cam01: 'matrix' is missing; calibrate again; clocks are found"),
        ('name = "cam02"', 'name = "other"', "film: its calibration lacks camera cam02; clocks are found without it"),
        ("[metadata]", "[metadata]", ""),
    ],
)
def test_a_calibration_that_clocks_cannot_use_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, old: str, new: str, warning: str
) -> None:
    """Otherwise the person is asked to wave, though the file is at fault."""
    folder = rec.write_pose2sim(tmp_path / "film")
    calibration = folder / "calibration" / "Calib.toml"
    calibration.write_text(calibration.read_text().replace(old, new))
    used = Mock()
    monkeypatch.setattr(recording, "_track", lambda *_: None)
    monkeypatch.setattr(recording, "estimate_clocks", used)
    synchronise_recording(folder)
    assert (used.call_args.args[1] is None) == bool(warning)
    warnings = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert len(warnings) == bool(warning) and all(warning in one for one in warnings)


def test_clocks_are_of_the_footage_that_the_calibrated_capture_is_read_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pose2Sim's layout reads videos even if there are images, whose frame rate is not known."""
    folder = rec.write_pose2sim(tmp_path / "film")
    for name in ("cam01", "cam02"):
        write_image(folder / "images" / name / "000000.png", np.zeros((48, 64, 3), np.uint8))
    read = dict[str, tuple[Path, int]]()

    def track(alone: Uncalibrated, name: str, *_: object) -> None:
        read[name] = alone.footage(name).path, len(alone.keypoint_files(name))

    monkeypatch.setattr(recording, "_track", track)
    monkeypatch.setattr(recording, "estimate_clocks", Mock())
    synchronise_recording(folder)
    assert read == {name: (folder / "videos" / f"{name}.mp4", 10) for name in ("cam01", "cam02")}


def test_tracks_are_in_pixels_of_the_recorded_images(tmp_path: Path) -> None:
    """Images are shrunk to 1024 px on reading."""
    seen = filmed(0, 0.1, 0.0).keypoints * [2.048, 2.048, 1]
    folder = write_recording(tmp_path / "film", {"c0": seen}, side_px=2048)
    track = _track(Uncalibrated(folder, only="c0"), "c0", 30.0, None, tmp_path)
    np.testing.assert_allclose(track.keypoints, seen, atol=1e-3)
    np.testing.assert_allclose(track.times_s, [0, 1 / 30, 2 / 30])


def test_tracks_are_undistorted_only_once_by_a_known_lens(tmp_path: Path) -> None:
    """A lens of k1 = 0.25 images radius 0.4 at 0.4 (1 + 0.04): 500 + 416 px is 500 + 400 without distortion. If
    `intri.yml` undistorts the images, keypoints are undistorted already."""
    K, distortion = np.array([[1000.0, 0, 500], [0, 1000, 500], [0, 0, 1]]), np.array([0.25, 0, 0, 0])
    lens = Lens("c0", K, distortion, np.eye(3), np.zeros(3), (1000, 1000))
    seen = np.broadcast_to([916.0, 500.0, 0.8], (3, 25, 3)) + 1e-3 * np.arange(25)[:, None] * [0, 1, 0]
    folder = write_recording(tmp_path / "film", {"c0": seen})
    for scratch in (tmp_path / "given", tmp_path / "read"):
        track = _track(Uncalibrated(folder, only="c0"), "c0", 30.0, lens, scratch)
        assert track.keypoints[0, 0].tolist() == pytest.approx([900, 500, 0.8], abs=0.05)
        write_easymocap(folder, [lens])


def test_a_folder_without_recordings_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tasks.cage.run_caged", in_this_process)
    for command in (["calibrate", str(tmp_path), "--from", "person", "--out", str(tmp_path / "x")],
                    ["synchronise", str(tmp_path)]):  # fmt: skip
        assert main(command) == 2
        assert "add the recordings" in capsys.readouterr().err

"""Videos without calibration: one is a capture, several need calibrated cameras."""

import logging
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.capture import Capture, SubjectPoint, write_image
from hnerf.capture.ingest import ingest, lacks_calibration
from hnerf.config import CaptureSettings
from hnerf.geometry.axes import CAMERA_FROM_Z_UP
from tests.capture import recordings as rec
from tests.capture.recordings import HEIGHT, WIDTH, K, write_calibration, write_easymocap, write_keypoints, write_video

SETTINGS = CaptureSettings()


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    write_video(tmp_path / "my clip.mp4", 6)
    return tmp_path / "my clip.mp4"


def test_a_single_video_is_a_capture(clip: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """At 64 x 48 px, the focal length is 0.85 of the longer side: 54.4 px."""
    with caplog.at_level(logging.WARNING):
        ingest(clip, SETTINGS, tmp_path / "out")
    found = Capture.load(tmp_path / "out")
    assert "assuming a level camera that sees 61 degrees across its longer side" in caplog.text
    assert "in capture.toml, in a folder with the video" in caplog.text  # files next to it are not read
    camera = found.cameras["my clip"]
    assert found.name == "my clip" and found.frames == (0, 1, 2, 3, 4, 5) and not found.has_keypoints
    np.testing.assert_allclose(camera.K, [[54.4, 0, 31.5], [0, 54.4, 23.5], [0, 0, 1]], atol=1e-3)
    np.testing.assert_allclose(camera.centre_m, 0)
    uv, depth_m = camera.project(np.array([[0, 2.0, 0.5]]))  # 2 m ahead, half a metre up: above the middle
    np.testing.assert_allclose(uv, [[31.5, 23.5 - 54.4 / 4]], atol=1e-3)
    assert depth_m == 2


@pytest.mark.parametrize(
    ("file", "subject", "camera"),
    [
        ("PXL_20230101_120000.TS.mp4", "PXL_20230101_120000.TS", "camera"),
        ("WhatsApp Video 2024-01-02 at 10.11.12.mp4", "WhatsApp Video 2024-01-02 at 10.11.12", "camera"),
        ("it's me.mp4", "it_s me", "camera"),
        ("-clip.mp4", "_clip", "camera"),
        ("Zoe\u0308.mp4", "Zo\u00eb", "Zo\u00eb"),
    ],
)
def test_file_names_given_by_phones_are_accepted(tmp_path: Path, file: str, subject: str, camera: str) -> None:
    write_video(tmp_path / "x.mp4", 3)
    found = ingest((tmp_path / "x.mp4").rename(tmp_path / file), SETTINGS, tmp_path / "out")
    assert found.name == subject and found.train_cameras == (camera,)


def test_one_of_several_videos_is_a_capture_if_it_alone_is_named(tmp_path: Path) -> None:
    """As the refusal of a recording in which no other camera sees the person says."""
    folder = tmp_path / "film"
    for name, frames in (("a", 3), ("b", 5)):
        write_video(folder / f"{name}.mp4", frames)
    assert lacks_calibration(folder) and "2 videos without calibration" in rec.refusal(folder, tmp_path / "out")
    (folder / "capture.toml").write_text('[cameras]\ntrain = ["b"]\n')
    assert not lacks_calibration(folder)
    found = ingest(folder, SETTINGS, tmp_path / "out")
    assert found.train_cameras == ("b",) and len(found.frames) == 5
    np.testing.assert_allclose(found.cameras["b"].R, CAMERA_FROM_Z_UP)


def test_a_file_name_that_is_too_long_is_refused(clip: Path, tmp_path: Path) -> None:
    long = clip.rename(clip.with_name("a" * 129 + ".mp4"))
    assert "aaa.mp4: name 'aaaa" in rec.refusal(long, tmp_path / "out")


@pytest.mark.parametrize("place", ["videos/front.MP4", "front.mov", "videos/front.mp4"])
def test_the_field_of_view_may_be_stated_in_a_folder(
    place: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """90 degrees: the focal length is half the longer side."""
    folder = tmp_path / "ada"
    write_video(tmp_path / "clip.mp4", 3, (48, 64))
    (folder / place).parent.mkdir(parents=True)
    (tmp_path / "clip.mp4").rename(folder / place)
    (folder / "capture.toml").write_text("field_of_view_deg = 90\n")
    capture = ingest(folder, SETTINGS, tmp_path / "out")
    assert capture.name == "ada" and capture.cameras["front"].K[0, 0] == pytest.approx(32)
    assert "assumed" not in caplog.text


def test_the_world_of_one_camera_has_z_up(tmp_path: Path) -> None:
    write_video(tmp_path / "ada" / "front.mp4", 3)
    (tmp_path / "ada" / "capture.toml").write_text('up = "y"\n')
    message = rec.refusal(tmp_path / "ada", tmp_path / "out")
    assert "capture.toml: up: without a calibration, Z is up; remove the line" in message


def test_known_data_of_a_single_video_are_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Lens, keypoints, masks and plate in EasyMocap's layout are read; the lens of another camera is refused."""
    folder = tmp_path / "ada"
    write_video(folder / "videos" / "01.mp4", 3, (WIDTH, HEIGHT))
    write_calibration(folder)
    (folder / "extri.yml").unlink()
    for frame in range(3):
        write_keypoints(folder / "openpose" / "01" / f"{frame:06d}_keypoints.json", [np.tile([9.0, 9, 0.5], (25, 1))])
        write_image(
            folder / "masks" / "01" / f"{frame:06d}.png", np.full((HEIGHT, WIDTH), 255 * (frame == 1), np.uint8)
        )
    write_image(folder / "background" / "01.png", np.full((HEIGHT, WIDTH, 3), 9, np.uint8))
    found = ingest(folder, SETTINGS, tmp_path / "out")
    np.testing.assert_allclose(found.cameras["01"].K, K)
    np.testing.assert_allclose(found.cameras["01"].R, CAMERA_FROM_Z_UP)
    assert found.keypoints("01") is not None and "WARNING" not in caplog.text
    masks, plate = [found.given_mask("01", frame) for frame in range(3)], found.background("01")
    assert [mask is not None and bool(mask.all()) for mask in masks] == [False, True, False]
    assert plate is not None and (plate == 9).all()
    (folder / "videos" / "01.mp4").rename(folder / "videos" / "front.mp4")
    assert rec.refusal(folder, tmp_path / "again").endswith(
        "intri.yml: has no camera front; give video and camera one name"
    )


def test_several_videos_need_cameras(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_video(tmp_path / "ada" / f"{name}.mp4", 3)
    (tmp_path / "ada" / "capture.toml").write_text('up = "y"\n')  # applies once there are cameras
    assert "footage of a board, or with --from person" in rec.refusal(tmp_path / "ada", tmp_path / "out")


def test_videos_next_to_their_calibration_are_read(tmp_path: Path) -> None:
    folder = tmp_path / "ada"
    folder.mkdir()
    write_calibration(folder)
    for name in ("01", "02"):
        write_video(folder / f"{name}.mp4", 3, (24, 16))
    assert ingest(folder, SETTINGS, tmp_path / "out").train_cameras == ("01", "02")


def test_files_that_are_not_videos_are_refused(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"0" * 1000)
    (tmp_path / "notes.txt").write_text("seen")
    assert "clip.mp4: not a readable video" in rec.refusal(tmp_path / "clip.mp4", tmp_path / "out")
    assert "notes.txt: is none of" in rec.refusal(tmp_path / "notes.txt", tmp_path / "out")


def test_the_subject_is_named_in_recorded_pixels(tmp_path: Path) -> None:
    """Images of 24 x 16 px are halved: (13, 5) becomes (13.5 / 2 - .5, 5.5 / 2 - .5); frame 4 is not used, 3 is."""
    folder = write_easymocap(tmp_path / "ada")
    half = CaptureSettings.model_construct(max_side_px=12, max_frames=60)
    for text, expected in (
        ("nearest to (13, 5) in 02 at frame 4", SubjectPoint((6.25, 2.25), "02", 3)),
        ("nearest to (13, 5) in 02", SubjectPoint((6.25, 2.25), "02", 0)),
        ("nearest to (-0.5, 2)", SubjectPoint((-0.5, 2.0), "", -1)),
        ("Ada Lovelace", None),
    ):
        (folder / "capture.toml").write_text(f'subject = "{text}"\n[frames]\ntrain = [0, 3]\n')
        ingest(folder, half, tmp_path / "out")
        assert Capture.load(tmp_path / "out").subject_point == expected

"""Ingestion: pixels, cameras and keypoints of a small recording, worked out by hand."""

import logging
import unicodedata
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from PIL import Image

from hnerf.capture.capture import Capture, write_image
from hnerf.capture.formats.export import write_cameras
from hnerf.capture.ingest import ingest
from hnerf.capture.lens import Lens
from hnerf.capture.manifest import read_manifest
from hnerf.capture.video_metadata import is_hdr
from hnerf.config import CaptureSettings
from hnerf.errors import InputError
from tests.capture import recordings as rec
from tests.capture.mp4 import state_transfer, write_video
from tests.shared_data import shared_capture

SETTINGS = CaptureSettings()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return rec.write_easymocap(tmp_path / "person")


def test_without_capture_toml_everything_is_for_training(folder: Path, tmp_path: Path) -> None:
    capture = ingest(folder, SETTINGS, tmp_path / "out")
    assert (capture.name, capture.fps, capture.up) == ("person", 30.0, "z")
    assert capture.train_cameras == ("01", "02") and capture.test_cameras == ()
    assert capture.train_frames == (0, 1, 2, 3, 4) and capture.novel_pose_frames == ()


def test_unchanged_images_are_copied_byte_for_byte(folder: Path, tmp_path: Path) -> None:
    ingest(folder, SETTINGS, tmp_path / "out")
    for camera in rec.CAMERAS:
        for frame in rec.FRAMES:
            name = Path("images", camera, f"{frame:06d}.png")
            assert (tmp_path / "out" / name).read_bytes() == (folder / name).read_bytes()


def test_saved_capture_loads_equal(folder: Path, tmp_path: Path) -> None:
    written, loaded = ingest(folder, SETTINGS, tmp_path / "out"), Capture.load(tmp_path / "out")
    for camera in rec.CAMERAS:
        a, b = written.cameras[camera], loaded.cameras[camera]
        assert (a.name, a.width_px, a.height_px) == (b.name, b.width_px, b.height_px)
        assert np.array_equal(a.projection, b.projection)
    plain = ("name", "train_cameras", "train_frames", "recorded_sizes_px", "calibrated_sizes_px")
    assert all(getattr(written, field) == getattr(loaded, field) for field in plain)


def test_cameras_are_where_the_calibration_puts_them(folder: Path, tmp_path: Path) -> None:
    cameras = ingest(folder, SETTINGS, tmp_path / "out").cameras
    assert cameras["01"].centre_m == pytest.approx([-3, 0, 1], abs=1e-9)
    assert cameras["02"].centre_m == pytest.approx([0, -3, 1], abs=1e-9)
    # A point 3 m ahead of camera 02, 0.3 m to its right and 0.15 m below: 20 px * 0.3 / 3 = 2 px, and 1 px.
    pixel, depth_m = cameras["02"].project(np.array([0.3, 0.0, 0.85]))
    assert pixel == pytest.approx([13.5, 8.5]) and depth_m == pytest.approx(3.0)


def test_millimetres_become_metres(folder: Path, tmp_path: Path) -> None:
    rec.write_calibration(folder, t_scale=1000.0)
    (folder / "capture.toml").write_text('units = "mm"\n')
    assert ingest(folder, SETTINGS, tmp_path / "out").cameras["01"].centre_m == pytest.approx([-3, 0, 1])


def test_capture_toml_sets_names_and_splits(folder: Path, tmp_path: Path) -> None:
    (folder / "capture.toml").write_text(
        'name = "Ann B."\nfps = 12.5\nup = "y"\nlicence = "CC0"\n[cameras]\ntrain = ["02"]\ntest = ["01"]\n'
        "[frames]\ntrain = [3, 1]\nnovel_pose = [4]\n"
    )
    capture = ingest(folder, SETTINGS, tmp_path / "out")
    assert (capture.name, capture.fps, capture.up) == ("Ann B.", 12.5, "y")
    assert (capture.train_cameras, capture.test_cameras) == (("02",), ("01",))
    assert (capture.train_frames, capture.novel_pose_frames, capture.frames) == ((1, 3), (4,), (1, 3, 4))
    assert {p.name[:6] for p in (tmp_path / "out" / "images" / "01").iterdir()} == {"000001", "000003", "000004"}


@pytest.mark.parametrize("stated", [False, True])
def test_images_without_a_frame_rate_get_a_warning(
    folder: Path, stated: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    if stated:
        (folder / "capture.toml").write_text("fps = 30\n")
    ingest(folder, SETTINGS, tmp_path / "out")
    warning = f"{folder}: images state no frame rate: 30 frames a second assumed; if that is wrong, set fps in"
    assert (warning in caplog.text) != stated


def test_frames_may_be_ranges(tmp_path: Path) -> None:
    """Their ends are excluded, as in Python. A range of novel poses goes around the frames that are trained on."""
    (tmp_path / "capture.toml").write_text('[frames]\ntrain = "1:8:3"\nnovel_pose = "3:7"\n')
    frames = read_manifest(tmp_path).frames
    assert frames is not None and (frames.train, frames.novel_pose) == ([1, 4, 7], [3, 5, 6])
    for wrong in ("3", "3:", "a:b", "3:3", "0:1000001", "0:9:0", "0:9999999999", "٣:٩"):
        (tmp_path / "capture.toml").write_text(f'[frames]\ntrain = "{wrong}"\n')
        with pytest.raises(InputError, match=r'frames\.train: give a list of frames, or "FIRST:END"'):
            read_manifest(tmp_path)
    (tmp_path / "capture.toml").write_text('[frames]\ntrain = "0:5"\nnovel_pose = "1:4"\n')
    with pytest.raises(InputError, match="all frames of this range are under train; name others"):
        read_manifest(tmp_path)


@pytest.mark.parametrize(("transfer", "hdr"), {"Rec. 709": (1, False), "PQ": (16, True), "HLG": (18, True)}.values())
def test_videos_state_whether_they_are_hdr(transfer: int, hdr: bool, tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", [10])
    state_transfer(tmp_path / "a.mp4", transfer)
    assert is_hdr(tmp_path / "a.mp4") == hdr


@pytest.mark.parametrize("hdr", [False, True])
def test_hdr_video_gets_a_warning(
    hdr: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The video itself is ordinary: OpenCV takes seconds to open one that is HDR."""
    monkeypatch.setattr("hnerf.capture.ingest.is_hdr", lambda _: hdr)
    write_video(tmp_path / "film" / "a.mp4", [10, 20, 30])
    ingest(tmp_path / "film", CaptureSettings(), tmp_path / "out")
    assert ("a.mp4: colours of HDR video" in caplog.text) == hdr


def test_files_of_uncalibrated_cameras_get_a_warning(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (folder / "capture.toml").write_text("fps = 30\n")
    with caplog.at_level(logging.WARNING, "hnerf.capture"):
        ingest(folder, SETTINGS, tmp_path / "out")
        assert not caplog.messages
        for camera in ("1", "2", "\n", "5", "6", "7"):
            write_image(folder / "masks" / camera / "000000.png", rec.picture("01", 0))
        for camera in ("1", "01"):
            write_image(folder / "background" / f"{camera}.png", rec.picture("01", 0))
        (folder / "keypoints").mkdir()
        for camera in ("01", "cam02"):
            (folder / "keypoints" / f"{camera}.json").write_text("[]")
        ingest(folder, SETTINGS, tmp_path / "again")
    assert caplog.messages == [
        f"{folder}/{found} not in the calibration, and not read; rename or remove them"
        for found in ("keypoints: 'cam02'", r"masks: '\n', '1', '2', '5', '6', ...", "background: '1'")
    ]


def test_a_folder_in_place_of_a_clean_plate_is_refused(folder: Path, tmp_path: Path) -> None:
    write_image(folder / "background" / "01" / "000000.png", rec.picture("01", 0))
    message = rec.refusal(folder, tmp_path / "out")
    assert "background/01: a folder; give one clean plate a camera, as 01.png beside" in message


def test_long_recordings_are_strided_evenly_and_this_is_logged(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "hnerf.capture"):
        assert ingest(folder, CaptureSettings(max_frames=3), tmp_path / "out").train_frames == (0, 2, 4)
        assert "3 of 5 frames taken, one in 2; name others in capture.toml" in caplog.text
        caplog.clear()
        ingest(folder, CaptureSettings(max_frames=5), tmp_path / "all")
        assert "frames taken" not in caplog.text


def test_frames_before_and_after_anybody_is_seen_are_left_out(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Camera 02 sees somebody in frames 1 and 3 only, camera 01 in none: 0 and 4 are dropped; 2, in between, stays."""
    for camera, empty in (("01", rec.FRAMES), ("02", (0, 2, 4))):
        for frame in empty:
            rec.write_keypoints(folder / "openpose" / camera / f"{frame:06d}_keypoints.json", [])
    capture = ingest(folder, SETTINGS, tmp_path / "out")
    assert capture.train_frames == (1, 2, 3)
    assert "frames 0 to 0 left out: nobody is there yet" in caplog.text
    assert "frames 4 to 4 left out: nobody is there any more" in caplog.text
    found = {camera: capture.keypoints(camera) for camera in rec.CAMERAS}
    assert found["02"] is not None and found["02"][:, 0, 0, 0].tolist() == [4.0, 0.0, 6.0]
    assert found["01"] is not None and not found["01"].any()
    assert {path.stem for path in (tmp_path / "out" / "images" / "01").iterdir()} == {"000001", "000002", "000003"}
    (folder / "capture.toml").write_text("[frames]\ntrain = [0, 1]\n")
    assert ingest(folder, SETTINGS, tmp_path / "named").train_frames == (0, 1)


def test_keypoints_hold_all_people_in_frame_order(folder: Path, tmp_path: Path) -> None:
    keypoints = ingest(folder, SETTINGS, tmp_path / "out").keypoints("02")
    assert keypoints is not None and keypoints.shape == (5, 2, 25, 3)
    assert keypoints[:, 0, 7].tolist() == [[3.0 + frame, 5.0, 0.5] for frame in rec.FRAMES]
    assert keypoints[2, 1, 7].tolist() == [6.0, 5.0, 0.5]
    assert not keypoints[[0, 1, 3, 4], 1].any()


def test_shrinking_also_scales_cameras_keypoints_and_masks(folder: Path, tmp_path: Path) -> None:
    mask = np.zeros((rec.HEIGHT, rec.WIDTH), np.uint8)
    mask[:8, :12] = 1  # not 255: anything but black is the person
    for camera in rec.CAMERAS:
        for frame in rec.FRAMES:
            write_image(folder / "masks" / camera / f"{frame:06d}.png", np.repeat(mask[..., None], 3, -1))
    capture = ingest(folder, CaptureSettings(max_side_px=16), tmp_path / "out")  # 24 x 16 -> 16 x 11
    camera, keypoints, shrunk = capture.cameras["01"], capture.keypoints("01"), capture.given_mask("01", 0)
    assert camera.size_px == (16, 11) and capture.image("01", 0).shape == (11, 16, 3)
    assert capture.recorded_sizes_px["01"] == (24, 16)
    sx, sy = 16 / 24, 11 / 16
    assert camera.K[0].tolist() == pytest.approx([20 * sx, 0, (11.5 + 0.5) * sx - 0.5])
    assert keypoints is not None and keypoints[0, 0, 0] == pytest.approx([(3.5 * sx) - 0.5, (5.5 * sy) - 0.5, 0.5])
    assert shrunk is not None and shrunk[:5, :8].all() and not shrunk[6:].any() and not shrunk[:, 8:].any()


def test_jpeg_masks_do_not_grow(folder: Path, tmp_path: Path) -> None:
    """Next to an edge, hardly any pixel of a JPEG is exactly black."""
    mask = np.zeros((rec.HEIGHT, rec.WIDTH, 3), np.uint8)
    mask[3:13, 5:19] = 255
    for camera in rec.CAMERAS:
        for frame in rec.FRAMES:
            write_image(folder / "masks" / camera / f"{frame:06d}.jpg", mask)
    assert (cv2.imread(str(folder / "masks" / "01" / "000000.jpg"))[..., 0] > 0).sum() > 140
    found = ingest(folder, SETTINGS, tmp_path / "out").given_mask("01", 0)
    assert found is not None and np.array_equal(found, mask[..., 0] > 0)


def test_mattes_are_thresholded_in_the_middle_but_labels_at_zero(folder: Path, tmp_path: Path) -> None:
    """Camera 01 has mattes with a ramp of 3 px next to the person; only one of them has many levels, elsewhere in the
    image. Camera 02 has labels; label 1 is the person."""
    matte, labels = np.zeros((rec.HEIGHT, rec.WIDTH, 3), np.uint8), np.zeros((rec.HEIGHT, rec.WIDTH, 3), np.uint8)
    matte[3:13, 5:19], labels[3:13, 5:19] = 255, 1
    matte[3:13, 19:22] = np.array([190, 120, 60])[:, None]
    many = matte.copy()
    many[13:] = np.linspace(0, 100, many[13:, :, 0].size).reshape(many.shape[0] - 13, -1)[..., None]
    check_given_masks(folder, tmp_path, [many if frame == 2 else matte for frame in rec.FRAMES], labels)


def test_antialiased_masks_do_not_grow(folder: Path, tmp_path: Path) -> None:
    """Camera 01: the person covers a quarter of the pixels at the left edge, three quarters of those at the right edge.
    Camera 02 has two parts of the person, drawn as 100 and 255."""
    covered = np.zeros((rec.HEIGHT, rec.WIDTH, 3), np.uint8)
    parts = covered.copy()
    covered[3:13, 5:19], parts[3:13, 5:19] = 255, 255
    covered[3:13, 4], covered[3:13, 19] = 64, 191
    parts[9:13, 5:19] = 100
    check_given_masks(folder, tmp_path, [covered] * len(rec.FRAMES), parts)


def check_given_masks(folder: Path, tmp_path: Path, mattes: list[np.ndarray], labels: np.ndarray) -> None:
    """Check that camera 01's masks (H, W, 3), one a frame, are thresholded in the middle, and 02's, the same in all
    frames, at zero."""
    for frame, matte in zip(rec.FRAMES, mattes, strict=True):
        write_image(folder / "masks" / "01" / f"{frame:06d}.png", matte)
        write_image(folder / "masks" / "02" / f"{frame:06d}.png", labels)
    capture = ingest(folder, SETTINGS, tmp_path / "out")
    for frame, matte in zip(rec.FRAMES, mattes, strict=True):
        soft, hard = (capture.given_mask(camera, frame) for camera in rec.CAMERAS)
        assert soft is not None and np.array_equal(soft, matte[..., 0] > 127)
        assert hard is not None and np.array_equal(hard, labels[..., 0] > 0)


def test_a_distorted_recording_is_undistorted(folder: Path, tmp_path: Path) -> None:
    """k1 = -0.5: what the lens shows at radius r (1 - 0.5 r^2) belongs at radius r."""
    rec.write_calibration(folder, distortion=(-0.5, 0, 0, 0))
    # At r = 0.4 the lens shows 0.4 (1 - 0.5 * 0.16) = 0.368: 20 px * 0.368 = 7.36 px right of 11.5.
    points = np.tile([11.5 + 7.36, 7.5, 0.9], (25, 1))
    for frame in rec.FRAMES:
        rec.write_keypoints(folder / "openpose" / "01" / f"{frame:06d}_keypoints.json", [points])
    ramp = np.repeat(np.arange(rec.WIDTH, dtype=np.uint8)[None, :, None] * 10, rec.HEIGHT, 0).repeat(3, -1)
    for frame in rec.FRAMES:
        write_image(folder / "images" / "01" / f"{frame:06d}.png", ramp)
    capture = ingest(folder, SETTINGS, tmp_path / "out")
    keypoints = capture.keypoints("01")
    assert keypoints is not None and keypoints[0, 0, 0] == pytest.approx([11.5 + 8.0, 7.5, 0.9], abs=1e-3)
    # Pixel (19, 7): x = 7.5 / 20, r^2 = 0.375^2 + 0.025^2; shown at 11.5 + 7.5 (1 - 0.5 r^2), on a ramp of 10 a pixel.
    expected = 10 * (11.5 + 7.5 * (1 - 0.5 * (0.375**2 + 0.025**2)))
    assert capture.image("01", 0)[7, 19] == pytest.approx([expected] * 3, abs=2.5)  # remap rounds to 1/32 px; JPEG
    assert np.array_equal(capture.cameras["01"].K, np.array(rec.K))


def test_a_straight_line_before_a_fisheye_is_ingested_straight(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """An equidistant lens of 40 px sees an edge along x = 0.5 + 0.2 y, white on its right, which is at straight pixel
    59.5 + 40 x. The half-width of 60 px is 86 degrees wide, of which the straight image keeps 56; a keypoint at 45
    degrees, 40 pi / 4 px from the middle, moves to 40 px."""
    folder = rec.write_easymocap(tmp_path / "ada")
    lenses = [Lens(n, np.array([[40.0, 0, 59.5], [0, 40, 44.5], [0, 0, 1]]), np.zeros(4), np.array(rec.ROTATIONS[n]),
                   np.array(rec.TRANSLATIONS_M[n]), (120, 90), fisheye=True) for n in rec.CAMERAS]  # fmt: skip
    (folder / "extri.yml").unlink()
    write_cameras(folder, lenses, "aniposelib")
    x, y = np.meshgrid((np.arange(120) - 59.5) / 40, (np.arange(90) - 44.5) / 40)
    angle = np.hypot(x, y)
    across_px = np.clip(40 * (np.tan(np.minimum(angle, 1.55)) / angle * (x - 0.2 * y) - 0.5), -9, 9)
    grey = np.repeat(255 / (1 + np.exp(-across_px))[..., None], 3, -1).astype(np.uint8)
    for camera in rec.CAMERAS:
        for frame in rec.FRAMES:
            write_image(folder / "images" / camera / f"{frame:06d}.png", grey)
            points = np.tile([59.5 + 10 * np.pi, 44.5, 0.9], (25, 1))
            rec.write_keypoints(folder / "openpose" / camera / f"{frame:06d}_keypoints.json", [points])
    ingest(folder, SETTINGS, tmp_path / "out")
    capture = Capture.load(tmp_path / "out")
    rows = capture.image("01", 0)[..., 0].astype(float)
    edge = np.array([np.interp(127.5, row[60:110], np.arange(60, 110)) for row in rows])
    expected = 59.5 + 40 * 0.5 + 0.2 * (np.arange(90) - 44.5)
    assert np.abs(edge - expected).max() < 0.3 and np.abs(expected - np.mean(expected)).max() > 8
    keypoints, lens = capture.keypoints("01"), capture.recorded_lens("01")
    assert keypoints is not None and keypoints[0, 0, 0] == pytest.approx([99.5, 44.5, 0.9], abs=1e-3)
    assert lens is not None and lens.fisheye and lens.K.tolist() == lenses[0].K.tolist()
    assert np.array_equal(capture.cameras["01"].K, lenses[0].K)
    assert sum("cuts off the borders" in message for message in caplog.messages) == 2


def test_a_fisheye_with_a_focal_length_in_millimetres_is_refused(tmp_path: Path) -> None:
    """2.2 mm, as if in pixels: of the half-width of 12 px, 2.2 atan(12 / 2.2) = 3.1 px are kept, of the half-height of
    8 px 2.2 atan(8 / 2.2) = 2.9 px, together 9 % of the picture."""
    folder = rec.write_easymocap(tmp_path / "ada")
    lenses = [Lens(n, np.array([[2.2, 0, 11.5], [0, 2.2, 7.5], [0, 0, 1]]), np.zeros(4), np.array(rec.ROTATIONS[n]),
                   np.array(rec.TRANSLATIONS_M[n]), (24, 16), fisheye=True) for n in rec.CAMERAS]  # fmt: skip
    (folder / "extri.yml").unlink()
    write_cameras(folder, lenses, "aniposelib")
    assert "would cut off 9" in (text := rec.refusal(folder, tmp_path / "out")) and "give its K in pixels" in text


def test_undistortion_that_cuts_off_much_of_the_picture_gets_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The border 12 px from the middle of 24 x 16 px, 0.6 focal lengths, is imaged at 12 (1 + 0.36 k1). In the middle
    row, k1 = -0.02 thus cuts off 0.7 % of the pixels, and -0.2 cuts off 7 %; in other rows, more."""
    folder = rec.write_easymocap(tmp_path / "ada")
    for k1, cameras in ((-0.02, []), (-0.2, ["01", "02"])):
        caplog.clear()
        rec.write_calibration(folder, distortion=(k1, 0, 0, 0, 0))
        ingest(folder, CaptureSettings(), tmp_path / str(k1))
        warnings = [message for message in caplog.messages if "cuts off the borders" in message]
        assert [message.split()[4] for message in warnings] == cameras
        shares = [int(message.split(", ")[1].split(" %")[0]) for message in warnings]
        assert all(share >= 7 for share in shares)


def test_clean_plates_are_ingested(folder: Path, tmp_path: Path) -> None:
    write_image(folder / "background" / "01.png", rec.picture("01", 99))
    capture = ingest(folder, SETTINGS, tmp_path / "out")
    plate = capture.background("01")
    assert plate is not None and np.array_equal(plate, rec.picture("01", 99))
    assert capture.background("02") is None


@pytest.mark.parametrize("line", ["W_01: 24\n", "H_01: 16\n"])
def test_a_calibrated_size_with_one_side_missing_is_refused(line: str, folder: Path, tmp_path: Path) -> None:
    """Otherwise it would be ignored, and images of any size would be accepted."""
    text = (folder / "intri.yml").read_text()
    assert line in text
    (folder / "intri.yml").write_text(text.replace(line, ""))
    assert "intri.yml: has one of W_01 and H_01; add the other" in rec.refusal(folder, tmp_path / "out")


def test_padding_within_two_percent_is_accepted_and_recorded(folder: Path, tmp_path: Path) -> None:
    text = (folder / "intri.yml").read_text()
    (folder / "intri.yml").write_text(text.replace("W_01: 24", "W_01: 240").replace("H_01: 16", "H_01: 160"))
    for frame in rec.FRAMES:
        write_image(folder / "images" / "01" / f"{frame:06d}.png", np.full((160, 236, 3), 9, np.uint8))
    capture = ingest(folder, CaptureSettings(max_side_px=118), tmp_path / "out")
    assert capture.calibrated_sizes_px["01"] == (240, 160) and capture.recorded_sizes_px["01"] == (236, 160)
    assert capture.cameras["01"].size_px == (118, 80)
    assert capture.cameras["01"].K[0, 0] == pytest.approx(10.0)  # the calibrated 20, halved with the image


def test_grey_images_with_alpha_are_read(folder: Path, tmp_path: Path) -> None:
    for path in (folder / "images" / "01").iterdir():
        Image.open(path).convert("LA").save(path)
    grey = ingest(folder, SETTINGS, tmp_path / "out").image("01", 0)
    assert np.array_equal(grey[..., 0], grey[..., 1])


def test_a_utf_8_byte_order_mark_is_ignored(folder: Path, tmp_path: Path) -> None:
    (folder / "capture.toml").write_text('name = "ada"', encoding="utf-8-sig")
    path = folder / "openpose" / "01" / "000000_keypoints.json"
    path.write_text(path.read_text(), encoding="utf-8-sig")
    assert ingest(folder, SETTINGS, tmp_path / "out").name == "ada"


def test_file_suffixes_may_be_in_upper_case(tmp_path: Path) -> None:
    for write in (rec.write_easymocap, rec.write_pose2sim):
        folder = write(tmp_path / write.__name__)
        for path in [*folder.glob("openpose/*/*"), *folder.glob("pose/*/*"), *folder.glob("videos/*")]:
            path.rename(path.with_suffix(path.suffix.upper()))
        assert ingest(folder, SETTINGS, tmp_path / f"{write.__name__}-out").has_keypoints


@pytest.mark.parametrize("prefix", ["", "clip_07_"])
def test_keypoint_files_may_have_the_names_that_openpose_gives_them(folder: Path, tmp_path: Path, prefix: str) -> None:
    plain = ingest(folder, SETTINGS, tmp_path / "plain").keypoints("01")
    for path in folder.glob("openpose/*/*"):
        path.rename(path.with_name(f"{prefix}{int(path.stem[:6]):012d}_keypoints.json"))
    assert np.array_equal(ingest(folder, SETTINGS, tmp_path / "out").keypoints("01"), plain)


def test_videos_are_read_by_frame(tmp_path: Path) -> None:
    folder = rec.write_pose2sim(tmp_path / "walker")
    capture = ingest(folder, CaptureSettings(max_frames=3), tmp_path / "out")
    # The last fifth of ten frames is for novel poses; eight are strided by three.
    assert capture.train_frames == (0, 3, 6) and capture.novel_pose_frames == (8,)
    assert capture.fps == pytest.approx(25.0)
    for frame in (0, 3, 6, 8):
        assert capture.image("cam02", frame).mean() == pytest.approx(20 + 20 * frame, abs=3)


def test_a_shared_capture_is_ingested_unchanged(wave: Capture) -> None:
    assert (len(wave.train_frames), len(wave.novel_pose_frames)) == (24, 12)
    image = cv2.imread(str(shared_capture("valid-wave") / "images" / "05" / "000035.jpg"))[..., ::-1]
    assert np.array_equal(wave.image("05", 35), image)


def test_the_step_between_recorded_frame_numbers_is_kept(folder: Path, tmp_path: Path) -> None:
    """Frames 0 to 4 are renumbered 0, 3, 6, 9 and 12; of these, capture.toml chooses the first and the last."""
    for path in sorted([*folder.glob("images/*/*"), *folder.glob("openpose/*/*")], reverse=True):
        path.rename(path.with_name(f"{3 * int(path.name[:6]):06d}{path.name[6:]}"))
    (folder / "capture.toml").write_text("[frames]\ntrain = [0, 12]\n")
    capture = ingest(folder, SETTINGS, tmp_path / "out")
    assert capture.frames == (0, 12) and capture.frame_step == 3


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_accents_in_names_may_be_composed_or_decomposed(tmp_path: Path, form: Literal["NFC", "NFD"]) -> None:
    """macOS decomposes them in file names, editors compose them, or the other way round."""
    folder = rec.write_easymocap(tmp_path / "ada")
    other: Literal["NFC", "NFD"] = "NFD" if form == "NFC" else "NFC"
    written, named = (unicodedata.normalize(one, "K\u00e4te") for one in (form, other))
    for file in ("intri.yml", "extri.yml"):
        text = (folder / file).read_text().replace('"01"', f'"{written}"').replace("_01:", f"_{written}:")
        (folder / file).write_text(text)
    (folder / "capture.toml").write_text(f'[cameras]\ntrain = ["{written}", "02"]\n')
    for part in ("images", "openpose"):
        (folder / part / "01").rename(folder / part / named)
    write_image(folder / "background" / f"{named}.png", rec.picture("01", 9))
    capture = ingest(folder, CaptureSettings(), tmp_path / "out")
    assert capture.train_cameras == ("K\u00e4te", "02") and capture.keypoints("K\u00e4te") is not None
    assert capture.background("K\u00e4te") is not None

"""Recordings without a calibration: which cameras there are, what is known of their lenses, and what is refused."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from hnerf.capture.capture import SubjectPoint, write_image
from hnerf.capture.footage import Video
from hnerf.capture.formats import easymocap
from hnerf.capture.formats.caliscope import Caliscope
from hnerf.capture.formats.easymocap import EasyMocap
from hnerf.capture.formats.from_person import FromPerson
from hnerf.capture.ingest import ingest, lacks_calibration, recognise
from hnerf.capture.lens import Lens
from hnerf.capture.uncalibrated import Uncalibrated, cameras_without_calibration, lens_by_angle
from hnerf.capture.video_metadata import KEY, MAX_METADATA_BYTES, focal_35mm
from hnerf.config import CaptureSettings
from hnerf.errors import InputError
from tests.capture.mp4 import QUARTER_TURN, box, show_as, state_pixel_aspect
from tests.capture.recordings import write_easymocap, write_video


def write_images(folder: Path, camera: str, exif: Image.Exif | None = None) -> None:
    place = folder / "images" / camera
    place.mkdir(parents=True)
    for frame in range(2):
        Image.new("RGB", (200, 100)).save(place / f"{frame:06d}.jpg", exif=exif or Image.Exif())


@pytest.mark.parametrize(
    ("fov_deg", "focal_mm", "focal_px", "source"),
    [
        (90, 26, 100, "90 degrees given"),  # half of 200 / tan 45
        (None, 26, 26 / 43.27 * np.hypot(200, 100), "26 mm, metadata"),
        (None, None, 170, ""),  # a guess
    ],
)
def test_the_lens_comes_from_a_given_angle_metadata_or_a_guess(
    fov_deg: float | None, focal_mm: int | None, focal_px: float, source: str, tmp_path: Path
) -> None:
    exif = Image.Exif()
    exif[0x8769] = {0xA405: focal_mm} if focal_mm else {}
    write_images(tmp_path, "a", exif)
    known = Uncalibrated(tmp_path, fov_deg=fov_deg).known_lenses["a"]
    assert np.allclose(known.lens.K, [[focal_px, 0, 99.5], [0, focal_px, 49.5], [0, 0, 1]])
    assert known.source == source


def apple_metadata(focal_mm: int) -> bytes:
    """Return a box of metadata with two keys, the second of which is Apple's."""
    keys = box(b"keys", struct.pack(">II", 0, 2) + box(b"mdta", b"com.apple.quicktime.make") + box(b"mdta", KEY))
    item = box(struct.pack(">I", 2), box(b"data", struct.pack(">IIh", 21, 0, focal_mm)))
    return box(b"meta", keys + box(b"ilst", item))


def test_a_videos_metadata_give_the_focal_length(tmp_path: Path) -> None:
    video = tmp_path / "a.mp4"
    video.write_bytes(box(b"ftyp", b"qt  ") + box(b"moov", apple_metadata(28)))
    whole = video.read_bytes()
    assert focal_35mm(video) == 28
    video.write_bytes(whole[:-1])
    assert focal_35mm(video) is None
    start = whole.index(b"moov") - 4  # the last box may omit its size, however much comes before
    video.write_bytes(box(b"free", bytes(MAX_METADATA_BYTES)) + whole[:start] + bytes(4) + whole[start + 4 :])
    assert focal_35mm(video) == 28


def test_pixels_that_are_not_square_have_two_focal_lengths(tmp_path: Path) -> None:
    """90 x 60 pixels, 4/3 as wide as they are high, are shown as 120 x 60: 90 degrees across have a focal length of 60
    heights, or 45 widths, of a pixel. Turned by 90 degrees, they are 60 x 90 pixels, 3/4 as wide as they are high, or
    45 x 90 shown: 45 heights, or 60 widths. No camera has pixels a hundred times as wide as high."""
    video = tmp_path / "a.mp4"
    for stated, matrix, focal_px in (
        ((4, 3), None, (45, 60)),
        ((4, 3), QUARTER_TURN, (60, 45)),
        ((100, 1), None, (45, 45)),
        ((0, 0), None, (45, 45)),
    ):
        write_video(video, 2, size_px=(90, 60))
        state_pixel_aspect(video, *stated)
        if matrix:
            show_as(video, matrix)
        K = lens_by_angle("a", Video(video, (0,), None), 90).lens.K
        assert (K[0, 0], K[1, 1]) == pytest.approx(focal_px)


def test_a_tracks_metadata_give_the_focal_length_if_the_movies_do_not(tmp_path: Path) -> None:
    tracks = box(b"trak", box(b"tkhd", b"")) + box(b"trak", box(b"tkhd", b"") + apple_metadata(24))
    video = tmp_path / "a.mov"
    for movie, expected in ((b"", 24), (box(b"meta", b""), 24), (apple_metadata(28), 28)):
        video.write_bytes(box(b"ftyp", b"qt  ") + box(b"moov", tracks + movie))
        assert focal_35mm(video) == expected


@pytest.mark.parametrize("name", ["intri.yml", "lenses.toml"])
def test_a_lens_file_takes_precedence(tmp_path: Path, name: str) -> None:
    for camera in "ab":
        write_images(tmp_path, camera)
    matrix = "K_a: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n  data: [150, 0, 99, 0, 150, 49, 0, 0, 1]\n"
    table = '[a]\nname = "a"\nsize = [200, 100]\nmatrix = [[150, 0, 99], [0, 150, 49], [0, 0, 1]]\n'
    table += "distortions = [0.1, 0, 0, 0]\nfisheye = true\n"
    file = tmp_path / name
    file.write_text(f"%YAML:1.0\n---\nnames:\n  - a\n{matrix}" if name == "intri.yml" else table)
    known = Uncalibrated(tmp_path, file, 90).known_lenses
    assert known["a"].lens.K[0].tolist() == [150, 0, 99] and known["a"].source == f"from {name}"
    assert known["a"].lens.t_m.tolist() == [0, 0, 0] and known["b"].source == "90 degrees given"
    assert known["a"].lens.fisheye == (name == "lenses.toml")


def test_intrinsics_are_left_to_the_calibration_that_is_read(tmp_path: Path) -> None:
    """Else keypoints are undistorted by an old intri.yml, for cameras of a new calibration.toml."""
    write_images(tmp_path, "a")
    matrix = "K_a: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n  data: [150, 0, 99, 0, 150, 49, 0, 0, 1]\n"
    (tmp_path / "intri.yml").write_text(f"%YAML:1.0\n---\nnames:\n  - a\n{matrix}")
    for calibrated, used in ((None, True), (EasyMocap(tmp_path), True), (Caliscope(tmp_path), False)):
        known = Uncalibrated(tmp_path, only="a", calibrated=calibrated).known_lenses
        assert (known["a"].source == "from intri.yml") == used


def test_lenses_that_a_calibration_estimated_are_used_only_if_their_file_is_named(tmp_path: Path) -> None:
    for camera in "ab":
        write_images(tmp_path, camera)
    K, here = np.array([[150.0, 0, 99], [0, 150, 49], [0, 0, 1]]), (np.zeros(4), np.eye(3), np.zeros(3), (200, 100))
    easymocap.write_easymocap(tmp_path, [Lens("a", K, *here), Lens("b", K, *here, estimated=True)])
    assert [known.source for known in Uncalibrated(tmp_path).known_lenses.values()] == ["from intri.yml", ""]
    named = Uncalibrated(tmp_path, tmp_path / "intri.yml").known_lenses
    assert [known.source for known in named.values()] == ["from intri.yml"] * 2
    intri = cv2.FileStorage(str(tmp_path / "intri.yml"), cv2.FILE_STORAGE_READ)  # as EasyMocap reads it
    assert intri.getNode("K_b").mat()[0, 0] == 150


def test_a_lens_file_with_two_cameras_of_one_name_is_refused(tmp_path: Path) -> None:
    write_images(tmp_path, "a")
    file = tmp_path / "lenses.toml"
    lens = 'name = "a"\nsize = [2, 1]\nmatrix = [[15, 0, 9], [0, 15, 9], [0, 0, 1]]\ndistortions = [0, 0, 0, 0]\n'
    file.write_text(f"[a]\n{lens}[b]\n{lens}")
    with pytest.raises(InputError, match=r"lenses\.toml: two cameras are called a"):
        Uncalibrated(tmp_path, file).lenses()


def test_a_lens_file_of_other_cameras_is_refused(tmp_path: Path) -> None:
    write_images(tmp_path, "b")
    file = tmp_path / "lenses.toml"
    file.write_text(
        '[a]\nname = "a"\nsize = [2, 1]\nmatrix = [[15, 0, 9], [0, 15, 9], [0, 0, 1]]\ndistortions = [0, 0, 0, 0]\n'
    )
    with pytest.raises(InputError, match="has none of the cameras b"):
        Uncalibrated(tmp_path, file).lenses()


def test_a_lens_file_without_intrinsics_is_refused(tmp_path: Path) -> None:
    write_images(tmp_path, "a")
    here = (np.eye(3), np.zeros(4), np.eye(3), np.zeros(3), (200, 100))
    easymocap.write_easymocap(tmp_path, [Lens("a", *here)])
    with pytest.raises(InputError, match=r"extri.yml: has no intrinsics \(K_<camera>\); give an intri.yml$"):
        Uncalibrated(tmp_path, tmp_path / "extri.yml").lenses()


@pytest.mark.parametrize("place", ["", "videos"])
def test_videos_are_cameras_and_are_ingested_without_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    """Photos and hidden folders do not hide them. Each is decoded once to count its frames."""
    folder, opened, opening = tmp_path / "film", list[str](), Video.open
    for name in ("left", "right"):
        write_video(folder / place / f"{name}.mp4", 3, (64, 96))
    (folder / "images" / ".thumbnails").mkdir(parents=True)  # of a file manager
    (folder / "images" / "poster.jpg").touch()
    assert cameras_without_calibration(folder) == ["left", "right"]
    monkeypatch.setattr(Video, "open", lambda path: opened.append(path.name) or opening(path))
    capture = ingest(folder, CaptureSettings(), tmp_path / "out", Uncalibrated(folder))
    assert capture.train_cameras == ("left", "right") and len(capture.frames) == 3
    assert capture.cameras["left"].K[0, 0] == pytest.approx(0.85 * 96)
    assert sorted(opened) == ["left.mp4", "right.mp4"]


def test_images_take_precedence_over_a_video_of_the_same_name(tmp_path: Path) -> None:
    write_images(tmp_path, "left")
    write_video(tmp_path / "left.mp4", 3)
    assert Uncalibrated(tmp_path).footage("left").frames == (0, 1)  # the video has three


@pytest.mark.parametrize("place", ["", "videos"])
def test_two_videos_of_one_name_are_refused_but_a_sound_file_is_not_a_video(tmp_path: Path, place: str) -> None:
    write_video(tmp_path / place / "ada.mp4", 3)
    (tmp_path / place / "ada.wav").touch()
    assert cameras_without_calibration(tmp_path) == ["ada"]
    (tmp_path / place / "ada.MOV").touch()
    with pytest.raises(InputError, match=r"ada\.mp4: camera ada is also ada\.MOV; keep one of them"):
        cameras_without_calibration(tmp_path)


def test_an_uncalibrated_recording_is_refused_with_the_command_to_calibrate_it(tmp_path: Path) -> None:
    write_images(tmp_path, "a")
    with pytest.raises(InputError, match=r"images/a: one camera .* make a video"):  # one camera cannot be calibrated
        recognise(tmp_path)
    write_images(tmp_path, "b")
    with pytest.raises(InputError, match=r"no calibration.*hnerf calibrate .* --from person"):
        recognise(tmp_path)


@pytest.mark.parametrize(
    ("toml", "only", "point"),
    [
        ('subject = "nearest to (3, 5) in 01 at frame 0"', "02", None),
        ('subject = "nearest to (3, 5) in 01 at frame 0"', "01", SubjectPoint((3.0, 5.0), "01", 0)),
        ('subject = "nearest to (3, 5) in 01 at frame 0"', None, SubjectPoint((3.0, 5.0), "01", 0)),
        ('subject = "nearest to (0.5, -1.2)"', None, None),
        ("[frames]\ntrain = [0, 1, 2, 3, 4]", "02", None),
    ],
)
def test_settings_that_need_other_cameras_or_the_ground_are_ignored(
    tmp_path: Path, toml: str, only: str | None, point: SubjectPoint | None
) -> None:
    """Camera 02, read alone, is a frame shorter than `capture.toml` says; the ground is not known yet."""
    folder = write_easymocap(tmp_path / "ada")
    (folder / "capture.toml").write_text(f"{toml}\n")
    if only == "02":
        (folder / "images" / "02" / "000004.png").unlink()
        (folder / "openpose" / "02" / "000004_keypoints.json").unlink()
    capture = ingest(folder, CaptureSettings(), tmp_path / "out", Uncalibrated(folder, only=only))
    assert capture.subject_point == point and len(capture.frames) == (4 if only == "02" else 5)


@pytest.mark.parametrize("only", [None, "02"])
def test_given_masks_and_clean_plates_are_read_without_calibration(tmp_path: Path, only: str | None) -> None:
    """The person's outlines refine cameras found from the person. A camera's clock needs none."""
    folder = write_easymocap(tmp_path / "ada")
    for frame in range(5):
        write_image(folder / "masks" / "02" / f"{frame}.png", np.full((16, 24), 255, np.uint8))
    write_image(folder / "background" / "02.png", np.full((16, 24, 3), 9, np.uint8))
    capture = ingest(folder, CaptureSettings(), tmp_path / "out", Uncalibrated(folder, only=only))
    mask, plate = capture.given_mask("02", 3), capture.background("02")
    assert (mask is not None and mask.all()) == (plate is not None and (plate == 9).all()) == (only is None)


def test_board_footage_is_not_read_without_calibration(tmp_path: Path) -> None:
    """Cameras are read one by one, and the board would be searched for again each time."""
    folder = write_easymocap(tmp_path / "ada")
    write_image(folder / "calibration" / "extrinsic" / "01" / "0.png", np.zeros((16, 24, 3), np.uint8))
    (folder / "capture.toml").write_text("[board]\ncolumns = 4\nrows = 5\nsquare_m = 0.05\n")
    capture = ingest(folder, CaptureSettings(), tmp_path / "out", Uncalibrated(folder, only="02"))
    assert not (capture.root / "boards.npz").exists()


def test_which_folders_lack_a_calibration(tmp_path: Path) -> None:
    """Several cameras without calibration do; one video, other layouts, and cameras that a board shows do not. A phone
    may have named the video as no camera can be named."""
    for name in ("one", "two", "boards"):
        write_video(tmp_path / name / "a.mp4", 2)
    (tmp_path / "one" / "a.mp4").rename(tmp_path / "one" / "VID 2024-01-01 at 10.00.00.mp4")
    for name in ("two", "boards"):
        write_video(tmp_path / name / "b.mp4", 2)
    write_images(tmp_path / "images", "a")
    write_images(tmp_path / "images", "b")
    (tmp_path / "boards" / "calibration" / "extrinsic").mkdir(parents=True)
    write_easymocap(tmp_path / "calibrated")
    assert {path.name for path in tmp_path.iterdir() if lacks_calibration(path)} == {"two", "images"}
    assert not lacks_calibration(tmp_path / "two" / "a.mp4")


@pytest.mark.parametrize("line", ['up = "y"', 'units = "mm"'])
def test_the_world_of_cameras_found_from_the_person_is_not_stated(tmp_path: Path, line: str) -> None:
    folder = write_easymocap(tmp_path / "film")
    easymocap.write_easymocap(folder, list(easymocap.EasyMocap(folder).lenses().values()))
    (folder / "capture.toml").write_text(line)
    with pytest.raises(InputError, match=r"capture\.toml: (up|units): .*; remove the line"):
        ingest(folder, CaptureSettings(), tmp_path / "out", FromPerson(folder, folder))


def test_only_the_cameras_that_are_named_are_used(tmp_path: Path) -> None:
    for camera in "abc":
        write_images(tmp_path, camera)
    (tmp_path / "capture.toml").write_text('[cameras]\ntrain = ["a"]\ntest = ["c"]\n')
    assert cameras_without_calibration(tmp_path) == ["a", "c"]


def test_a_named_camera_that_is_not_there_is_refused(tmp_path: Path) -> None:
    """Otherwise the recording would be read without it, or refused for want of cameras."""
    for camera in "abc":
        write_images(tmp_path, camera)
    (tmp_path / "capture.toml").write_text('[cameras]\ntrain = ["a", "b", "C"]\n')
    with pytest.raises(InputError, match=r"capture\.toml: camera C is not in the folder; correct \[cameras\]"):
        cameras_without_calibration(tmp_path)

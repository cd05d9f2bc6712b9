"""Descriptions of boards and the positions of their corners, worked out by hand."""

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from hnerf.capture.board_footage import Board, BoardDetector, load_board_corners, read_board, read_board_footage
from hnerf.capture.capture import write_image
from hnerf.capture.ingest import ingest
from hnerf.config import CaptureSettings
from hnerf.errors import InputError
from tests.capture import recordings as rec

CHARUCO = """
columns = 4
rows = 5
board_height = 11.0
board_width = 8.5
dictionary = "DICT_4X4_1000"
units = "inch"
aruco_scale = 0.75
square_size_override_cm = 5.4
inverted = true
"""
SQUARE_PX = 40


@pytest.fixture
def extrinsic(tmp_path: Path) -> Path:
    """Return the folder for footage in a folder that describes the board above."""
    (tmp_path / "charuco.toml").write_text(CHARUCO)
    return tmp_path / "calibration" / "extrinsic"


def charuco_picture(inverted: bool) -> np.ndarray:
    """Return the board above, 160 x 200 px, on a grey image of 320 x 240 px, with its top left pixel at (60, 20)."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    drawn = cv2.aruco.CharucoBoard((4, 5), 0.054, 0.0405, dictionary).generateImage((4 * SQUARE_PX, 5 * SQUARE_PX))
    picture = np.full((240, 320), 128, np.uint8)
    picture[20:220, 60:220] = 255 - drawn if inverted else drawn
    return np.stack([picture] * 3, -1)


def checkerboard_picture(columns: int, rows: int) -> np.ndarray:
    """Return squares of 40 px, beginning with a black one at pixel (60, 60), with a white margin of one and a half
    squares."""
    y, x = np.mgrid[: rows * SQUARE_PX, : columns * SQUARE_PX]
    picture = np.full((rows * SQUARE_PX + 120, columns * SQUARE_PX + 120), 255, np.uint8)
    picture[60:-60, 60:-60] = np.where((x // SQUARE_PX + y // SQUARE_PX) % 2, 255, 0)
    return np.stack([picture] * 3, -1)


def test_corners_between_the_squares_are_listed_row_by_row() -> None:
    corners_m = Board(columns=4, rows=3, square_m=0.1).corners_m
    expected = [[0.1, 0.1, 0], [0.2, 0.1, 0], [0.3, 0.1, 0], [0.1, 0.2, 0], [0.2, 0.2, 0], [0.3, 0.2, 0]]
    assert corners_m.tolist() == pytest.approx(np.array(expected))


def test_a_measured_square_size_takes_precedence_over_the_page_size(tmp_path: Path) -> None:
    (tmp_path / "charuco.toml").write_text(CHARUCO)
    board = read_board(tmp_path)
    assert board is not None and board.square_m == pytest.approx(0.054) and board.inverted
    (tmp_path / "charuco.toml").write_text(CHARUCO.replace("square_size_override_cm = 5.4\n", ""))
    page = read_board(tmp_path)
    assert page is not None and page.square_m == pytest.approx(min(8.5 / 4, 11 / 5) * 0.0254)


def test_a_board_may_be_described_in_capture_toml(tmp_path: Path) -> None:
    (tmp_path / "capture.toml").write_text("[board]\ncolumns = 7\nrows = 6\nsquare_m = 0.1\n")
    assert read_board(tmp_path) == Board(columns=7, rows=6, square_m=0.1)


@pytest.mark.parametrize("dictionary", ["DICT_APRILTAG_36h11", "DICT_APRILTAG_36H11"])
def test_a_dictionary_may_have_either_of_its_names_in_opencv(dictionary: str, tmp_path: Path) -> None:
    (tmp_path / "charuco.toml").write_text(CHARUCO.replace("DICT_4X4_1000", dictionary))
    board = read_board(tmp_path)
    assert board is not None and BoardDetector(board).charuco is not None


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("columns = 6\nrows = 8\nsquare_m = 0.1", "looks the same upside down"),
        ("columns = 3\nrows = 4\nsquare_m = 0.1", "OpenCV finds no checkerboard of 3 x 4 squares"),
        ("columns = 100000\nrows = 5\nsquare_m = 0.1", "board: columns"),
        ('columns = 4\nrows = 5\nsquare_m = 0.1\ndictionary = "DICT_4X4_9"', "not one of OpenCV's"),
        ('columns = 4\nrows = 5\nsquare_m = 0.1\ndictionary = "os.system"', "board: dictionary"),
        ('columns = 20\nrows = 20\nsquare_m = 0.1\ndictionary = "DICT_4X4_50"', "only 50 markers"),
        ("columns = 4\nrows = 5\nsquare_m = nan", "board: square_m"),
        ("columns = 4\nrows = 5\nsquare_m = 0.1\nsides = 2", "board: sides"),
        ("columns = 4\nrows = 5\nsquare_m = 1e-300", "board: square_m"),
        ("columns = 4\nrows = 5\nsquare_m = 0.1\nmarker_share = 1e-300", "board: marker_share"),
        ("columns = 4\nrows = 5\nsquare_m = 0.1\nmarker_share = 0.9999999999", "board: marker_share"),
    ],
)
def test_bad_descriptions_are_refused(table: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "capture.toml").write_text(f"[board]\n{table}\n")
    with pytest.raises(InputError, match="capture.toml.*" + message):
        read_board(tmp_path)


def test_overlong_numbers_in_charuco_toml_are_refused(tmp_path: Path) -> None:
    (tmp_path / "charuco.toml").write_text(CHARUCO.replace("= 5.4", "= " + "1" * 400))
    with pytest.raises(InputError, match=r"charuco\.toml: board: .* is missing or not a number") as refusal:
        read_board(tmp_path)
    assert len(str(refusal.value)) < 300


@pytest.mark.parametrize("inverted", [False, True])
def test_charuco_corners_lie_between_pixels(inverted: bool) -> None:
    """Corners lie between pixels 60 + 40 k - 1 and 60 + 40 k, whose centres are integers: at 59.5 + 40 k."""
    board = Board(columns=4, rows=5, square_m=0.054, dictionary="DICT_4X4_1000", inverted=inverted)
    found = BoardDetector(board).corners_px(charuco_picture(inverted))
    expected = [[59.5 + 40 * x, 19.5 + 40 * y] for y in (1, 2, 3, 4) for x in (1, 2, 3)]
    assert np.abs(found - expected).max() < 0.25
    assert np.isnan(BoardDetector(board).corners_px(charuco_picture(not inverted))).all()


@pytest.mark.parametrize("legacy", [False, True])
def test_a_board_of_even_rows_is_found_in_the_pattern_that_caliscope_names(legacy: bool, tmp_path: Path) -> None:
    """OpenCV before 4.6 began such boards with a white square."""
    stated = CHARUCO.replace("rows = 5", "rows = 6").replace("inverted = true", "inverted = false")
    (tmp_path / "charuco.toml").write_text(stated + "legacy_pattern = true\n" * legacy)
    board = read_board(tmp_path)
    assert board is not None
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    drawn = cv2.aruco.CharucoBoard((4, 6), 0.054, 0.0405, dictionary)
    drawn.setLegacyPattern(legacy)
    picture = drawn.generateImage((4 * SQUARE_PX, 6 * SQUARE_PX))
    picture = cv2.copyMakeBorder(picture, 20, 20, 20, 20, cv2.BORDER_CONSTANT, value=255)
    found = BoardDetector(board).corners_px(cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB))
    expected = [[19.5 + 40 * x, 19.5 + 40 * y] for y in (1, 2, 3, 4, 5) for x in (1, 2, 3)]
    assert np.abs(found - expected).max() < 0.25


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
def test_the_first_corner_of_a_checkerboard_is_the_same_at_any_rotation(quarter_turns: int) -> None:
    picture = checkerboard_picture(6, 5)
    found = BoardDetector(Board(columns=6, rows=5, square_m=0.1)).corners_px(np.rot90(picture, quarter_turns).copy())
    grid = np.array([[59.5 + 40 * x, 59.5 + 40 * y] for y in (1, 2, 3, 4) for x in (1, 2, 3, 4, 5)])
    height, width = picture.shape[:2]
    for _ in range(quarter_turns):  # np.rot90 turns counter-clockwise: (x, y) to (y, width - 1 - x)
        grid = np.stack([grid[:, 1], width - 1 - grid[:, 0]], -1)
        height, width = width, height
    assert np.abs(found - grid).max() < 0.25


def test_the_table_of_timestamps_reveals_dropped_frames(extrinsic: Path, tmp_path: Path) -> None:
    """cam_0 has no image with sync_index 11; the board is in its last image only, and in none of cam_1."""
    blank = np.full((240, 320, 3), 128, np.uint8)
    for camera, pictures in {"cam_0": [blank, charuco_picture(True)], "cam_1": [blank] * 3}.items():
        for i, picture in enumerate(pictures):
            write_image(extrinsic / camera / f"{i}.png", picture)
    rows = ["sync_index,cam_id,frame_time", "10,0,1.0", "10,1,1.0", "11,1,1.1", "12,1,1.2", "12,0,1.2"]
    (extrinsic / "timestamps.csv").write_text("\n".join(rows))
    footage = read_board_footage(tmp_path, "extrinsic")
    assert footage is not None and footage.frames == (10, 11, 12)
    assert np.isfinite(footage.corners_px["cam_0"]).all((1, 2)).tolist() == [False, False, True]
    assert np.isnan(footage.corners_px["cam_1"]).all()
    (extrinsic / "timestamps.csv").write_text("\n".join(rows[:-1]))
    with pytest.raises(InputError, match=r"timestamps\.csv: 1 rows of cam_0, but 2 frames"):
        read_board_footage(tmp_path, "extrinsic")


@pytest.mark.parametrize(
    ("rows", "message"),
    [(f"{'1' * 200_000},0\n", r"not a table \(field larger"), ("1,1\n" * 500_000, "2000018 bytes are too many")],
    ids=["an overlong field", "more than 2 MB"],
)
def test_an_oversized_table_of_timestamps_is_refused(rows: str, message: str, extrinsic: Path, tmp_path: Path) -> None:
    write_image(extrinsic / "cam_0" / "0.png", np.zeros((8, 8, 3), np.uint8))
    (extrinsic / "timestamps.csv").write_text(f"sync_index,cam_id\n{rows}")
    with pytest.raises(InputError, match=rf"timestamps\.csv: {message}"):
        read_board_footage(tmp_path, "extrinsic")


def test_footage_with_an_upper_case_suffix_is_read(extrinsic: Path, tmp_path: Path) -> None:
    for name in ("cam_1", "cam_0"):
        rec.write_video(extrinsic / f"{name}.mp4", 2)
    (extrinsic / "cam_1.mp4").rename(extrinsic / "cam_1.MP4")
    footage = read_board_footage(tmp_path, "extrinsic")
    assert footage is not None and list(footage.corners_px) == ["cam_0", "cam_1"]


def test_caliscopes_output_folder_next_to_the_footage_is_not_a_camera(
    extrinsic: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rec.write_video(extrinsic / "cam_0.mp4", 3)
    (extrinsic / "CHARUCO").mkdir()
    (extrinsic / "CHARUCO" / "image_points.csv").write_text("sync_index,cam_id\n")
    footage = read_board_footage(tmp_path, "extrinsic")
    assert footage is not None and list(footage.corners_px) == ["cam_0"]
    assert "CHARUCO: holds no JPEG or PNG images; ignored" in caplog.text


def test_footage_of_different_lengths_is_refused(extrinsic: Path, tmp_path: Path) -> None:
    for camera, count in {"cam_0": 3, "cam_1": 4}.items():
        rec.write_video(extrinsic / f"{camera}.mp4", count)
    with pytest.raises(InputError, match="videos differ in length"):
        read_board_footage(tmp_path, "extrinsic")
    assert read_board_footage(tmp_path, "intrinsic") is None


def test_images_of_different_sizes_are_refused(extrinsic: Path, tmp_path: Path) -> None:
    for number, side_px in enumerate((8, 16)):
        write_image(extrinsic / "cam_0" / f"{number}.png", np.zeros((side_px, side_px, 3), np.uint8))
    with pytest.raises(InputError, match=r"1\.png: is 16 x 16 px, unlike the pictures before"):
        read_board_footage(tmp_path, "extrinsic")


def test_links_in_the_footage_are_refused(extrinsic: Path, tmp_path: Path) -> None:
    (tmp_path / "secret").mkdir()
    extrinsic.mkdir(parents=True)
    (extrinsic / "cam_0").symlink_to(tmp_path / "secret")
    with pytest.raises(InputError, match="cam_0: is a symbolic link"):
        read_board_footage(tmp_path, "extrinsic")


def test_a_requested_frame_that_is_missing_is_refused(extrinsic: Path, tmp_path: Path) -> None:
    rec.write_video(extrinsic / "cam_0.mp4", 3)
    with pytest.raises(InputError, match="extrinsic: has no frame 3; name one of 0 to 2"):
        read_board_footage(tmp_path, "extrinsic", 3)


def test_long_footage_is_sampled_evenly(extrinsic: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hnerf.capture.board_footage.MAX_FRAMES", 4)
    rec.write_video(extrinsic / "cam_0.mp4", 10)
    footage = read_board_footage(tmp_path, "extrinsic")
    assert footage is not None and footage.frames == (0, 3, 6, 9) and footage.frame_step == 3
    for wanted, frames in {7: (1, 4, 7), 6: (0, 3, 6, 9)}.items():
        shifted = read_board_footage(tmp_path, "extrinsic", wanted)
        assert shifted is not None and shifted.frames == frames


def test_long_close_footage_of_one_camera_leaves_the_frames_of_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hnerf.capture.board_footage.MAX_FRAMES", 4)
    (tmp_path / "charuco.toml").write_text(CHARUCO)
    rec.write_video(tmp_path / "calibration" / "intrinsic" / "cam_0.mp4", 10)
    for number in (1, 2, 4, 5):
        write_image(tmp_path / "calibration" / "intrinsic" / "cam_1" / f"{number}.png", charuco_picture(True))
    footage = read_board_footage(tmp_path, "intrinsic")
    assert footage is not None and len(footage.corners_px["cam_0"]) == 4
    assert np.isfinite(footage.corners_px["cam_1"]).all() and len(footage.corners_px["cam_1"]) == 4


def test_ingested_board_corners_are_in_pixels_of_the_shrunk_images(tmp_path: Path) -> None:
    """At half the size, x becomes x / 2 - 1 / 4."""
    folder = rec.write_easymocap(tmp_path / "ada")
    for name in ("images", "openpose"):
        shutil.rmtree(folder / name)
    intri = re.sub(r"(W_0\d): 24", r"\1: 320", (folder / "intri.yml").read_text())
    (folder / "intri.yml").write_text(re.sub(r"(H_0\d): 16", r"\1: 240", intri))
    for camera in rec.CAMERAS:
        write_image(folder / "images" / camera / "000000.png", charuco_picture(True))
        write_image(folder / "calibration" / "extrinsic" / camera / "000003.png", charuco_picture(True))
    (folder / "charuco.toml").write_text(CHARUCO)
    capture = ingest(folder, CaptureSettings(max_side_px=160), tmp_path / "out")
    stored = load_board_corners(capture.root)
    assert stored is not None and (stored.cameras, stored.frame_step) == (rec.CAMERAS, 1)
    assert stored.frames == (3,) and stored.corners_px.shape == (2, 1, 12, 2)
    assert stored.corners_px[0, 0, 0].tolist() == pytest.approx([99.5 / 2 - 0.25, 59.5 / 2 - 0.25], abs=0.13)

"""Detection of black bars with known edges, and the lens that follows from them."""

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest

from hnerf.capture.bars import Area, lens_for_area, picture_area
from hnerf.capture.capture import Capture, write_image
from hnerf.capture.ingest import ingest
from hnerf.capture.lens import Lens
from hnerf.config import CaptureSettings
from tests.capture import recordings as rec
from tests.capture.recordings import WIDTH, picture, write_easymocap

LENS = Lens(
    "a", np.array([[200.0, 0, 99.5], [0, 200, 149.5], [0, 0, 1]]), np.zeros(5), np.eye(3), np.zeros(3), (200, 300)
)


def frames() -> list[np.ndarray]:
    """Return three frames of noise around grey 120, 200 x 300 px."""
    return [np.random.default_rng(seed).integers(60, 180, (300, 200, 3), np.uint8) for seed in range(3)]


def test_edges_are_found_to_a_fraction_of_a_pixel() -> None:
    pictures = frames()
    for rgb in pictures:
        rgb[:7] = 2
        rgb[-6:] = 3
        rgb[:, :4] = 0
        rgb[-7] = rgb[-7] * 0.6  # the image covers 0.6 of the height of its last row
    found = picture_area(pictures)
    assert found[:3] == pytest.approx((4, 7, 196), abs=0.1)
    assert found.top + found.height == pytest.approx(293.6, abs=0.1)


def test_a_full_or_dark_image_has_no_bars() -> None:
    assert picture_area(frames()) == (0, 0, 200, 300)
    assert picture_area([rgb // 20 for rgb in frames()]) == (0, 0, 200, 300)
    fade = np.linspace(0, 1, 40)[:, None, None]  # light that fades towards the top is not a bar
    pictures = frames()
    for rgb in pictures:
        rgb[:40] = rgb[:40] * fade**2
    assert picture_area(pictures) == (0, 0, 200, 300)


def test_an_edge_that_is_dark_in_one_frame_is_not_a_bar() -> None:
    pictures = frames()
    pictures[0][:7] = 0
    assert picture_area(pictures) == (0, 0, 200, 300)


def test_bars_are_found_with_little_memory_beyond_the_images() -> None:
    """Five images take 15 bytes per pixel; as floats they would take 40, and their median as much again."""
    pictures = [np.full((2048, 512, 3), 90 + i, np.uint8) for i in range(5)]
    tracemalloc.start()
    assert picture_area(pictures) == (0, 0, 512, 2048)
    assert tracemalloc.get_traced_memory()[1] < 20 * 2048 * 512
    tracemalloc.stop()


def test_the_lens_inside_bars_by_hand() -> None:
    # Half the size, 5 px from the left and 7 px from the top. The middle of the calibrated image, at pixel (99.5,
    # 149.5), is (100, 150) from the corner: (55, 82) from the new corner, at pixel (54.5, 81.5).
    lens = lens_for_area(LENS, Area(5, 7, 100, 150), (110, 164))
    assert lens is not None
    np.testing.assert_allclose(lens.K, np.array([[100, 0, 54.5], [0, 100, 81.5], [0, 0, 1]]))


def test_no_lens_follows_without_bars_or_at_another_aspect_ratio() -> None:
    assert lens_for_area(LENS, Area(0, 0, 100, 150), (100, 150)) is None
    assert lens_for_area(LENS, Area(5, 0, 100, 152), (110, 152)) is None


def test_ingestion_matches_a_letterboxed_camera_by_its_bars(tmp_path: Path) -> None:
    # Calibrated at 24 x 16, doubled to 48 x 32, put 20 px down in 48 x 72: the middle (11.5, 7.5) is at (23.5, 35.5).
    folder = write_easymocap(tmp_path / "in")
    for path in sorted((folder / "images" / "01").iterdir()):
        tall = cv2.resize(picture("01", int(path.stem)) // 2 + 100, (48, 32), interpolation=cv2.INTER_NEAREST)
        write_image(path, np.pad(tall, ((20, 20), (0, 0), (0, 0))))
    ingest(folder, CaptureSettings(), tmp_path / "out")
    capture = Capture.load(tmp_path / "out")
    assert capture.picture_areas_px["01"] == pytest.approx((0, 20, 48, 32), abs=0.2)
    expected = np.array([[40, 0, 23.5], [0, 40, 35.5], [0, 0, 1]])
    np.testing.assert_allclose(capture.cameras["01"].K, expected, atol=0.2)
    assert capture.recorded_sizes_px["01"] == (48, 72) and capture.calibrated_sizes_px["01"] == (WIDTH, 16)


def test_a_size_that_bars_do_not_explain_is_refused(tmp_path: Path) -> None:
    folder = write_easymocap(tmp_path / "in")
    for path in sorted((folder / "images" / "01").iterdir()):
        write_image(path, np.pad(picture("01", int(path.stem)), ((20, 20), (0, 9), (0, 0)), mode="wrap"))
    assert "000000.png: is 33 x 56 px, but camera 01 was calibrated at 24 x 16" in rec.refusal(folder, tmp_path / "out")

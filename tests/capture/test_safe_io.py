"""Untrusted images are read upright whatever their metadata say, and their size is limited."""

import os
import resource
import struct
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from peak_memory import peak_mib, reset_peak
from PIL import Image

from hnerf.capture.capture import Capture, read_rgb, read_rgba
from hnerf.capture.ingest import ingest
from hnerf.capture.safe_io import check_image_size, read_bytes, read_image, read_mask
from hnerf.config import CaptureSettings
from hnerf.errors import InputError
from tests.capture import recordings as rec

SHORT, LONG = 3, 4  # types of EXIF
ORIENTATION, DESCRIPTION = 0x112, 0x10E
XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b'<rdf:Description xmlns:tiff="http://ns.adobe.com/tiff/1.0/" tiff:Orientation="6"/></rdf:RDF></x:xmpmeta>'
)
STORED = rec.picture("01", 0)
# By EXIF orientation, with the sides at which row 0 and column 0 are seen.
UPRIGHT: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda a: a,  # top, left
    2: lambda a: a[:, ::-1],  # top, right
    3: lambda a: a[::-1, ::-1],  # bottom, right
    4: lambda a: a[::-1],  # bottom, left
    5: lambda a: a.swapaxes(0, 1),  # left, top
    6: lambda a: a.swapaxes(0, 1)[:, ::-1],  # right, top
    7: lambda a: a.swapaxes(0, 1)[::-1, ::-1],  # right, bottom
    8: lambda a: a.swapaxes(0, 1)[::-1],  # left, bottom
}


def exif(*entries: tuple[int, int, int]) -> bytes:
    """Return big-endian EXIF with entries (tag, type, number)."""
    values = {SHORT: ">HHIH2x", LONG: ">HHII"}
    packed = b"".join(struct.pack(values[kind], tag, kind, 1, number) for tag, kind, number in entries)
    return b"Exif\0\0MM\0*\0\0\0\x08" + struct.pack(">H", len(entries)) + packed + bytes(4)


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_images_are_read_upright(orientation: int, tmp_path: Path) -> None:
    Image.fromarray(STORED).save(tmp_path / "a.png", exif=exif((ORIENTATION, SHORT, orientation)))
    assert np.array_equal(read_image(tmp_path / "a.png"), UPRIGHT[orientation](STORED))


def test_damaged_metadata_and_xmp_do_not_matter(tmp_path: Path) -> None:
    """A number in place of a description cannot be written again, but the orientation is read. Nonsense is ignored."""
    odd, nonsense = exif((DESCRIPTION, SHORT, 7), (ORIENTATION, SHORT, 6)), exif((ORIENTATION, LONG, 1 << 31))
    for metadata, expected in ((odd, UPRIGHT[6](STORED)), (nonsense, STORED), (b"Exif\0\0MM", STORED)):
        Image.fromarray(STORED).save(tmp_path / "a.png", exif=metadata)
        assert np.array_equal(read_image(tmp_path / "a.png"), expected)
    Image.fromarray(STORED).save(tmp_path / "a.jpg", xmp=XMP)
    assert read_image(tmp_path / "a.jpg").shape == STORED.shape


@pytest.mark.parametrize("orientation", [(ORIENTATION, SHORT, 6), (ORIENTATION, SHORT, 2), (ORIENTATION, LONG, 6)])
def test_ingested_images_are_upright(orientation: tuple[int, int, int], tmp_path: Path) -> None:
    """OpenCV, which reads ingested images, applies EXIF itself, and does not know an orientation of another type."""
    folder = rec.write_easymocap(tmp_path / "person")
    sizes = [line for line in (folder / "intri.yml").read_text().splitlines() if not line.startswith(("W_", "H_"))]
    (folder / "intri.yml").write_text("\n".join(sizes))
    for path in (folder / "images").rglob("*.png"):
        Image.open(path).save(path, exif=exif(orientation))
    ingest(folder, CaptureSettings(), tmp_path / "out")
    kept = Capture.load(tmp_path / "out").image("01", 0)
    read = read_image(folder / "images/01/000000.png")
    assert kept.shape == read.shape and np.abs(kept.astype(int) - read).mean() < 8  # a JPEG of noise


@pytest.mark.parametrize(
    ("mode", "colour", "lightest"), [("L", 0, 0), ("L", 90, 90), ("RGB", (0, 0, 0), 0), ("RGB", (7, 90, 0), 90)]
)
def test_the_mask_of_a_cut_out_is_its_opacity(mode: str, colour: object, lightest: int, tmp_path: Path) -> None:
    """Colours of the person and of the transparent background do not count. An opaque image is read by its colours."""
    opacity = np.zeros((8, 6), np.uint8)
    opacity[2:6, 1:4] = 200
    for alpha, expected in ((opacity, opacity), (np.full_like(opacity, 255), np.full_like(opacity, lightest))):
        image = Image.new(mode, (6, 8), colour)  # type: ignore[arg-type]
        image.putalpha(Image.fromarray(alpha))
        image.save(tmp_path / "a.png")
        assert np.array_equal(read_mask(tmp_path / "a.png"), expected)


def test_empty_cut_outs_and_transparent_palette_entries_are_read(tmp_path: Path) -> None:
    """If nobody is left, hidden colours do not count. A palette entry or a grey level may be transparent."""
    Image.new("RGBA", (6, 8), (9, 90, 9, 0)).save(tmp_path / "nobody.png")
    assert not read_mask(tmp_path / "nobody.png").any()
    shape = np.full((8, 6), 120, np.uint8)
    shape[2:6, 1:4] = 30
    for mode in ("L", "P"):
        Image.fromarray(shape).convert(mode).save(tmp_path / "a.png", transparency=120)
        assert np.array_equal(read_mask(tmp_path / "a.png") > 0, shape == 30)


@pytest.mark.parametrize("size_px", [(6001, 6000), (32_767, 1), (1, 32_767), (0, 5), (float("nan"), 5)])
def test_sizes_that_no_camera_records_or_opencv_cannot_undistort_are_refused(size_px: tuple[float, float]) -> None:
    with pytest.raises(InputError, match=r"a\.png: declares .*; give 1 to 36 million pixels, no side over 32766"):
        check_image_size(Path("a.png"), *size_px)


def test_8k_video_and_narrow_strips_are_not_too_large() -> None:
    assert check_image_size(Path("a.mp4"), 7680.0, 4320.0) == (7680, 4320)
    assert check_image_size(Path("a.png"), 32_766, 1) == (32_766, 1)


def test_the_largest_image_takes_less_than_500_mb(tmp_path: Path) -> None:
    Image.new("RGBA", (6000, 6000)).save(tmp_path / "a.png", exif=exif((ORIENTATION, SHORT, 6)), compress_level=1)
    reset_peak()
    before_mib = peak_mib()
    read_image(tmp_path / "a.png")
    assert (peak_mib() - before_mib) << 20 < 500_000_000


@pytest.mark.parametrize("read", [read_image, read_rgb, read_rgba, lambda path: read_bytes(path, 10_000)])
def test_a_machine_without_room_for_open_files_is_not_bad_input(read: Callable[[Path], object], tmp_path: Path) -> None:
    """The same file is read before; then there are no more file numbers."""
    image = tmp_path / "0.png"
    Image.new("RGBA", (4, 3)).save(image)
    read(image)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    free = os.open(os.devnull, os.O_RDONLY)
    os.close(free)
    resource.setrlimit(resource.RLIMIT_NOFILE, (free, hard))
    try:
        with pytest.raises(OSError, match="Too many open files"):
            read(image)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_an_image_that_fails_without_a_message_is_bad_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Image, "open", mock.Mock(side_effect=ValueError))
    with pytest.raises(InputError, match=r"not a readable image \(ValueError\)"):
        read_image(tmp_path / "000000.png")

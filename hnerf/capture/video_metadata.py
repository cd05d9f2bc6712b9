"""Metadata of images (EXIF) and of videos (boxes of MP4 and QuickTime): focal lengths, numbers of samples."""

import re
import struct
from collections.abc import Iterator
from pathlib import Path

from PIL import Image

from hnerf.capture.safe_io import VIDEO_SUFFIXES

EXIF_IFD, EXIF_FOCAL_35MM = 0x8769, 0xA405
KEY = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
MAX_METADATA_BYTES = 16_000_000
MAX_TABLES_BYTES = 1 << 28  # of boxes with tables of samples; days of video
# Of QuickTime's well-known types 21 (signed), 22 (unsigned), 23 and 24 (floats), by their number of bytes.
FORMATS = {(21, 1): ">b", (21, 2): ">h", (21, 4): ">i", (22, 1): ">B", (22, 2): ">H", (22, 4): ">I", (23, 4): ">f",
           (24, 8): ">d"}  # fmt: skip


def focal_35mm(path: Path) -> float | None:
    """Return the focal length in millimetres, as of a 35 mm film, that an image or a video states; None where it states
    none that can be read."""
    try:
        found = _of_video(path) if path.suffix.lower() in VIDEO_SUFFIXES else _of_image(path)
    except (Image.DecompressionBombError, OSError, OverflowError, SyntaxError, ValueError):  # whoever reads it says so
        return None
    return found if found and 1 <= found <= 2000 else None


def declared_samples(path: Path) -> int:
    """Return the largest number of samples of one size that a track of a video declares, wherever among its boxes."""
    declared = re.findall(rb"stsz.{4}(?!\0{4}).{4}(.{4})", top_box(path, b"moov", MAX_TABLES_BYTES), re.DOTALL)
    return max((int.from_bytes(count, "big") for count in declared), default=0)


def _of_image(path: Path) -> float | None:
    with Image.open(path, formats=["JPEG", "PNG"]) as image:
        stated = image.getexif().get_ifd(EXIF_IFD).get(EXIF_FOCAL_35MM)
    return float(stated) if isinstance(stated, int | float) else None


def _of_video(path: Path) -> float | None:
    """Return the value of Apple's key in moov/meta (QuickTime File Format, "Metadata")."""
    moov = top_box(path, b"moov", MAX_METADATA_BYTES)
    meta = dict(boxes(moov)).get(b"meta", b"")
    parts = dict(boxes(meta)) or dict(boxes(meta[4:]))  # a full box in MP4, a plain one in QuickTime
    keys = parts.get(b"keys", b"")
    names = [content for _, content in boxes(keys[8:])]
    if KEY not in names:
        return None
    number = struct.pack(">I", names.index(KEY) + 1)
    value = dict(boxes(dict(boxes(parts.get(b"ilst", b""))).get(number, b""))).get(b"data", b"")
    if len(value) < 8:
        return None
    form = FORMATS.get((int.from_bytes(value[:4], "big"), len(value) - 8))
    return float(struct.unpack(form, value[8:])[0]) if form else None


def top_box(path: Path, wanted: bytes, most_bytes: int) -> bytes:
    """Return the content of a file's first box of this kind; empty where there is none, or a larger one."""
    with path.open("rb") as file:
        while len(head := file.read(8)) == 8:
            size, kind, start = int.from_bytes(head[:4], "big"), head[4:], 8
            if size == 0:  # to the end
                size = path.stat().st_size - file.tell() + len(head)
            if size == 1:
                size, start = int.from_bytes(file.read(8), "big"), 16
            if kind == wanted:
                return file.read(size - start) if start <= size <= most_bytes else b""
            if size < start:
                return b""
            file.seek(size - start, 1)
    return b""


def boxes(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield kind and content of the boxes that follow each other; nothing from where their sizes stop making sense."""
    at = 0
    while at + 8 <= len(content):
        size = int.from_bytes(content[at : at + 4], "big")
        if not 8 <= size <= len(content) - at:
            return
        yield content[at + 4 : at + 8], content[at + 8 : at + size]
        at += size

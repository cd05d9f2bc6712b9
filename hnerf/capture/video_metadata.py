"""Focal lengths in the metadata of images (EXIF) and of videos (boxes of MP4 and QuickTime); mirror images and high
dynamic range in the latter."""

import struct
from pathlib import Path

from PIL import Image

from hnerf.capture.boxes import boxes, movie_boxes
from hnerf.capture.safe_io import VIDEO_SUFFIXES

EXIF_IFD, EXIF_FOCAL_35MM = 0x8769, 0xA405
KEY = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
MAX_METADATA_BYTES = 16_000_000
STSD_HEADER_BYTES, VIDEO_ENTRY_BYTES = 8, 78  # before the inner boxes (ISO/IEC 14496-12, 8.5.2 and 12.1.3)
HDR_TRANSFERS = (16, 18)  # transfer characteristics of PQ and HLG (ISO/IEC 23091-2)
# `struct` formats of QuickTime's well-known types 21 (signed), 22 (unsigned), 23 and 24 (floats), by number of bytes.
FORMATS = {(21, 1): ">b", (21, 2): ">h", (21, 4): ">i", (22, 1): ">B", (22, 2): ">H", (22, 4): ">I", (23, 4): ">f",
           (24, 8): ">d"}  # fmt: skip


def focal_35mm(path: Path) -> float | None:
    """Return the 35 mm equivalent focal length in millimetres that an image or a video states; None if it states no
    readable one."""
    try:
        found = _of_video(path) if path.suffix.lower() in VIDEO_SUFFIXES else _of_image(path)
    except (Image.DecompressionBombError, OSError, OverflowError, SyntaxError, ValueError):  # reported when it is read
        return None
    return found if found and 1 <= found <= 2000 else None


def opencv_inverts(path: Path) -> bool:
    """Return whether OpenCV turns a video upside down: one to be shown mirrored, as front cameras may state, and not
    also on its side. It reads such a matrix in `tkhd` as the nearest rotation, by 0 instead of 180 degrees or the other
    way round."""
    header = _picture_track(path).get(b"tkhd", b"")
    if not header:
        return False
    matrix = header[52:] if header[0] else header[40:]  # with 64 or 32-bit times
    a, b, _, c, d = struct.unpack_from(">5i", matrix.ljust(20, bytes(1)))
    return bool(a * d < b * c and abs(a) > abs(b))


def is_hdr(path: Path) -> bool:
    """Return whether a video states high dynamic range (`colr`: HLG or PQ), the default of many phones. OpenCV decodes
    its values as if they were Rec. 709."""
    inner = _picture_track(path)
    for kind in (b"mdia", b"minf", b"stbl"):
        inner = dict(boxes(inner.get(kind, b"")))
    entries = boxes(inner.get(b"stsd", b"")[STSD_HEADER_BYTES:])
    described = [dict(boxes(content[VIDEO_ENTRY_BYTES:])).get(b"colr", b"") for _, content in entries]
    return any(int.from_bytes(colour[6:8], "big") in HDR_TRANSFERS for colour in described)


def _picture_track(path: Path) -> dict[bytes, bytes]:
    """Return the boxes of a file's first track of pictures by kind; none without one."""
    tracks = (dict(boxes(content)) for kind, content in movie_boxes(path, MAX_METADATA_BYTES) if kind == b"trak")
    return next((t for t in tracks if dict(boxes(t.get(b"mdia", b""))).get(b"hdlr", b"")[8:12] == b"vide"), {})


def _of_image(path: Path) -> float | None:
    with Image.open(path, formats=["JPEG", "PNG"]) as image:
        stated = image.getexif().get_ifd(EXIF_IFD).get(EXIF_FOCAL_35MM)
    return float(stated) if isinstance(stated, int | float) else None


def _of_video(path: Path) -> float | None:
    """Return the value of Apple's key in moov/meta, else in moov/trak/meta of the first track that has it (QuickTime
    File Format, "Metadata")."""
    movie = movie_boxes(path, MAX_METADATA_BYTES)
    tracks = [box for kind, content in movie if kind == b"trak" for box in boxes(content)]
    found = (_stated(content) for kind, content in movie + tracks if kind == b"meta")
    return next((value for value in found if value is not None), None)


def _stated(meta: bytes) -> float | None:
    """Return the value of Apple's key in a metadata box."""
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

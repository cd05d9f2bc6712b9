"""Small videos with what phones write but OpenCV does not: a rotation, an uneven frame rate, edit lists."""

import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

QUARTER_TURN = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)  # clockwise, as the matrix in tkhd
CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts")


def write_video(path: Path, levels: list[int], size_px: tuple[int, int] = (96, 64), fps: float = 25) -> None:
    """Write a video of uniform grey frames; the right half of each is black."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size_px)
    for level in levels:
        picture = np.full((size_px[1], size_px[0], 3), level, np.uint8)
        picture[:, size_px[0] // 2 :] = 0
        writer.write(picture)
    writer.release()


def rotate(path: Path) -> None:
    """Mark a video as to be shown turned by 90 degrees clockwise."""
    _edit(path, b"tkhd", lambda content: content[:40] + QUARTER_TURN + content[76:])


def hold_frames(path: Path, first: int, rest: int) -> None:
    """Make the `rest` frames of a video after the first `first` last twice as long."""

    def slower(content: bytes) -> bytes:
        (step,) = struct.unpack(">I", content[12:16])
        return struct.pack(">IIIIII", 0, 2, first, step, rest, 2 * step)

    _edit(path, b"stts", slower)
    path.write_bytes(path.read_bytes().replace(b"edts", b"free"))  # the edit list would cut it to its old length


def trim(path: Path, *edits: tuple[int | None, int], wide: bool = False) -> None:
    """Make a video show only some frames, as after trimming without encoding again. edits: the first frame, None for
    showing nothing, and the number of frames; wide: whether to write 64-bit numbers."""
    content = path.read_bytes()
    movie_rate, rate = (_number(content, kind, 12) for kind in (b"mvhd", b"mdhd"))
    step, form = _number(content, b"stts", 12), ">QqI" if wide else ">IiI"
    listed = [
        struct.pack(form, count * step * movie_rate // rate, -1 if first is None else first * step, 1 << 16)
        for first, count in edits
    ]
    _edit(path, b"elst", lambda _: struct.pack(">II", wide << 24, len(edits)) + b"".join(listed))


def declare_samples(path: Path, count: int) -> None:
    """Make a video declare this many samples of one byte each."""
    _edit(path, b"stsz", lambda _: struct.pack(">III", 0, 1, count))
    _edit(path, b"stsc", lambda _: struct.pack(">IIIII", 0, 1, 1, count, 1))
    _edit(path, b"stts", lambda _: struct.pack(">IIII", 0, 1, count, 1))


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", 8 + len(content)) + kind + content


def _number(content: bytes, kind: bytes, at: int) -> int:
    """Return the 32-bit number at offset `at` in the first box of a kind."""
    start = content.index(kind) + 4 + at
    return int.from_bytes(content[start : start + 4], "big")


def _edit(path: Path, wanted: bytes, change: Callable[[bytes], bytes]) -> None:
    path.write_bytes(_edited(path.read_bytes(), wanted, change))


def _edited(content: bytes, wanted: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """Return boxes with the content of one kind of box changed. moov comes last, so no offset changes."""
    done, at = b"", 0
    while at < len(content):
        size, kind = int.from_bytes(content[at : at + 4], "big"), content[at + 4 : at + 8]
        inner = content[at + 8 : at + size]
        if kind == wanted:
            inner = change(inner)
        elif kind in CONTAINERS:
            inner = _edited(inner, wanted, change)
        done += box(kind, inner)
        at += size
    return done

"""Boxes, the building blocks of MP4 and QuickTime files (ISO/IEC 14496-12)."""

import re
from collections.abc import Iterator
from pathlib import Path

from hnerf.errors import InputError

MAX_TABLES_BYTES = 1 << 28  # size of the boxes with sample tables; enough for days of video
MAX_REPEATS = 10  # samples times edits, per byte of the file
NO_TABLES = (b"mdat", b"free", b"skip", b"wide")
HEADERS = (b"mvhd", b"cmov")  # FFmpeg treats a box that begins with one of them as the header, whatever its kind
COMPRESSED = re.compile(rb"cmov.{4}dcom", re.DOTALL)
SAMPLES = re.compile(rb"stsz(?=.{8}(.{4}))", re.DOTALL)  # consumes the name only: what follows may hold the next
FRAGMENT_SAMPLES = re.compile(rb"trun(?=.{4}(.{4}))", re.DOTALL)
EDITS = re.compile(rb"elst(?=.{4}(.{4}))", re.DOTALL)


def movie_boxes(path: Path, most_bytes: int) -> list[tuple[bytes, bytes]]:
    """Return kind and content of the boxes in a file's first `moov`; none without a `moov`, or if it is larger."""
    movies = ((start, size_bytes) for kind, start, size_bytes in _top_boxes(path) if kind == b"moov")
    start, size_bytes = next(movies, (0, 0))
    return list(boxes(_content(path, start, size_bytes))) if size_bytes <= most_bytes else []


def boxes(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield kind and content of consecutive boxes, up to the first implausible size."""
    at = 0
    while at + 8 <= len(content):
        size = int.from_bytes(content[at : at + 4], "big")
        if not 8 <= size <= len(content) - at:
            return
        yield content[at + 4 : at + 8], content[at + 8 : at + size]
        at += size


def check_tables(path: Path) -> None:
    """Raise InputError for a video from which FFmpeg would build tables much larger than the file's own: one that
    declares more samples than it has bytes, repeats them in many edits, or has a compressed header, in whichever of its
    boxes."""
    tables_bytes, samples, fragments, edits = 0, 0, 0, 0
    for kind, start, size_bytes in _top_boxes(path):
        if kind in NO_TABLES and _content(path, start, 8)[4:] not in HEADERS:
            continue
        tables_bytes += size_bytes
        if tables_bytes > MAX_TABLES_BYTES:
            raise InputError(
                f"{path}: more than {MAX_TABLES_BYTES >> 20} MB of tables beside its frames; export it in shorter parts"
            )
        content = _content(path, start, size_bytes)
        if COMPRESSED.search(content):
            raise InputError(f"{path}: its header is compressed; export it again as H.264")
        samples += sum(_numbers(SAMPLES, content))
        fragments += sum(_numbers(FRAGMENT_SAMPLES, content))
        edits += sum(_numbers(EDITS, content))
    samples, file_bytes = max(samples, fragments), path.stat().st_size
    if samples > file_bytes:
        raise InputError(f"{path}: declares {samples} samples in {file_bytes} bytes; export it again as H.264")
    if samples * edits > MAX_REPEATS * file_bytes:
        raise InputError(f"{path}: repeats its frames in {edits} edits; export it again as H.264")


def _top_boxes(path: Path) -> Iterator[tuple[bytes, int, int]]:
    """Yield kind, content start and content size of a file's outer boxes, up to the first implausible size."""
    at, end = 0, path.stat().st_size
    with path.open("rb") as file:
        while len(head := file.read(8)) == 8:
            size, kind, head_bytes = int.from_bytes(head[:4], "big"), head[4:], 8
            if size == 0:  # to the end
                size = end - at
            elif size == 1:
                size, head_bytes = int.from_bytes(file.read(8), "big"), 16
            if size < head_bytes:
                return
            yield kind, at + head_bytes, min(size, end - at) - head_bytes
            at += size
            if at >= end:
                return
            file.seek(at)


def _content(path: Path, start: int, size_bytes: int) -> bytes:
    with path.open("rb") as file:
        file.seek(start)
        return file.read(size_bytes)


def _numbers(pattern: re.Pattern[bytes], content: bytes) -> list[int]:
    return [int.from_bytes(found, "big") for found in pattern.findall(content)]

"""Edit lists of MP4 and QuickTime: the frames that players show of a video trimmed without re-encoding.

Such a video begins with the key frame before the cut; the edit list gives the time range to show.
"""

import struct
from pathlib import Path

import numpy as np

from hnerf.capture.boxes import MAX_TABLES_BYTES, boxes, movie_boxes

MAX_EDITS = 1000
NOTHING = -1  # in place of a time: an edit that shows nothing
INSIDE = (b"mdia", b"minf", b"stbl", b"edts")


def shown_frames(path: Path, samples: int) -> int:
    """Return how many frames FFmpeg shows of a video's track with this many samples: those within its edit list; all if
    it has no readable edit list."""
    movie = movie_boxes(path, MAX_TABLES_BYTES)
    tracks = [_leaves(content) for kind, content in movie if kind == b"trak"]
    videos = [track for track in tracks if track.get(b"hdlr", b"")[8:12] == b"vide"]
    try:
        track = next(one for one in videos if _number(one[b"stsz"][8:12]) == samples)
        edits, shown_at = _edits(dict(movie)[b"mvhd"], track), _shown_at(track, samples)
        return sum(int(np.subtract(*np.searchsorted(shown_at, (end, begin)))) for begin, end in edits)
    except (LookupError, StopIteration, ValueError, ZeroDivisionError, struct.error):
        return samples


def _leaves(content: bytes) -> dict[bytes, bytes]:
    """Return the boxes of a track that matter here; of two boxes of one kind, the outer one."""
    found = dict(boxes(content))
    for kind in INSIDE:
        found = dict(boxes(found.get(kind, b""))) | found
    return found


def _edits(mvhd: bytes, track: dict[bytes, bytes]) -> list[tuple[int, int]]:
    """Return the start and end of each edit that shows something, in the track's time units. Raises ValueError if there
    are too many."""
    elst, rate, movie_rate = track[b"elst"], _time_scale(track[b"mdhd"]), _time_scale(mvhd)
    count, entry = _number(elst[4:8]), struct.Struct(">QqI" if elst[0] else ">IiI")
    if not 0 < count <= MAX_EDITS:
        raise ValueError(f"{count} edits")
    listed = [entry.unpack_from(elst, 8 + entry.size * i) for i in range(count)]
    lengths = [(2 * length * rate + movie_rate) // (2 * movie_rate) for length, _, _ in listed]  # rounded
    return [(begin, begin + n) for n, (_, begin, _) in zip(lengths, listed, strict=True) if begin != NOTHING]


def _shown_at(track: dict[bytes, bytes], samples: int) -> np.ndarray:
    """Return the display time of each sample, ascending, in the track's time units. Raises ValueError on a wrong
    table."""
    lasts = _expanded(track[b"stts"], ">u4", samples)
    offsets = _expanded(track[b"ctts"], ">i4", samples) if b"ctts" in track else 0
    return np.sort(np.cumsum(lasts) - lasts + offsets)


def _expanded(table: bytes, number: str, samples: int) -> np.ndarray:
    """Expand a run-length table to one number per sample. Raises ValueError if it covers another count of samples."""
    runs = np.frombuffer(table[8:], np.dtype([("count", ">u4"), ("number", number)]), _number(table[4:8]))
    if runs["count"].sum(dtype=np.int64) != samples:
        raise ValueError("another number of samples")
    return np.repeat(runs["number"].astype(np.int64), runs["count"])


def _time_scale(header: bytes) -> int:
    """Return the time units per second in the header of a movie or a track."""
    at = 20 if header[0] else 12
    return _number(header[at : at + 4])


def _number(content: bytes) -> int:
    return int(struct.unpack(">I", content)[0])

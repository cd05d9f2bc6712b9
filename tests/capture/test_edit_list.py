import struct
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.edit_list import shown_frames
from hnerf.capture.footage import Video
from hnerf.errors import InputError
from tests.capture.mp4 import trim, write_video

LEVELS = [40, 70, 100, 130, 160, 190, 220, 250]


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Return a video of eight frames, each brighter than the one before."""
    write_video(tmp_path / "a.mp4", LEVELS)
    return tmp_path / "a.mp4"


@pytest.mark.parametrize("wide", [False, True])
def test_frames_outside_the_edit_list_are_left_out(video: Path, wide: bool) -> None:
    """Of eight frames, the third to the sixth are shown; they begin in the middle of a group of pictures."""
    trim(video, (2, 4), wide=wide)
    opened = Video.open(video)
    assert opened.frames == (0, 1, 2, 3)
    assert opened.times_s == pytest.approx([0, 0.04, 0.08, 0.12])
    levels = [np.median(one.rgb[:, :40]) for one in opened.read(opened.frames)]
    assert levels == pytest.approx(LEVELS[2:6], abs=6)


def test_several_edits_after_a_gap_are_followed(video: Path) -> None:
    """Nothing is shown for two frames, then the first three, then the last two."""
    trim(video, (None, 2), (0, 3), (6, 2))
    levels = [np.median(one.rgb[:, :40]) for one in Video.open(video).read(range(5))]
    assert levels == pytest.approx(LEVELS[:3] + LEVELS[6:], abs=6)


def test_a_trimmed_video_that_is_cut_short_is_refused(video: Path) -> None:
    """The last of the six frames that are shown is lost."""
    trim(video, (2, 6))
    content = bytearray(video.read_bytes())
    sizes_end = content.index(b"stco") - 4
    content[sizes_end - 4 : sizes_end] = struct.pack(">I", 1)
    video.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.mp4: 6 frames declared, 5 could be read"):
        Video.open(video)


def test_all_frames_are_shown_if_the_header_is_empty(video: Path) -> None:
    trim(video, (2, 4))
    content = bytearray(video.read_bytes())
    where = content.index(b"mvhd")
    content[where : where + 4] = b"free"
    content[where - 4 : where - 4] = struct.pack(">I", 8) + b"mvhd"
    moov = content.index(b"moov")
    content[moov - 4 : moov] = struct.pack(">I", struct.unpack(">I", content[moov - 4 : moov])[0] + 8)
    video.write_bytes(content)
    assert shown_frames(video, 8) == 8


@pytest.mark.parametrize(
    ("kind", "at", "number"),
    [
        (b"elst", 8, 0),
        (b"elst", 8, 2),
        (b"elst", 8, 4_000_000_000),
        (b"mvhd", 16, 0),
        (b"stts", 12, 9),
        (b"stts", 8, 4_000_000_000),
        (b"stsz", 12, 7),
        (b"mdhd", 0, 0),
    ],
)
def test_all_frames_are_shown_if_the_edit_list_is_invalid(video: Path, kind: bytes, at: int, number: int) -> None:
    trim(video, (2, 4))
    content = bytearray(video.read_bytes())
    where = content.index(kind) + at
    content[where : where + 4] = struct.pack(">I", number)
    video.write_bytes(content)
    assert shown_frames(video, 8) == 8

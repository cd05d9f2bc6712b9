import struct
from pathlib import Path

import numpy as np
import pytest

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
    """The last of the six frames that are shown is lost; two more are hidden."""
    trim(video, (2, 6))
    content = bytearray(video.read_bytes())
    sizes_end = content.index(b"stco") - 4
    content[sizes_end - 4 : sizes_end] = struct.pack(">I", 1)
    video.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.mp4: 8 frames declared, 7 could be read"):
        Video.open(video)


@pytest.mark.parametrize("count", [0, 2])
def test_an_edit_list_of_another_length_than_it_says_counts_as_players_read_it(video: Path, count: int) -> None:
    trim(video, (2, 4))
    content = bytearray(video.read_bytes())
    where = content.index(b"elst") + 8
    content[where : where + 4] = struct.pack(">I", count)
    video.write_bytes(content)
    levels = [np.median(one.rgb[:, :40]) for one in Video.open(video).read(range(4))]
    assert levels == pytest.approx(LEVELS[2:6], abs=6)


def test_a_trimmed_video_with_a_wrong_table_is_refused(video: Path) -> None:
    """The table of sample durations counts nine samples of eight."""
    trim(video, (2, 4))
    content = bytearray(video.read_bytes())
    where = content.index(b"stts") + 12
    content[where : where + 4] = struct.pack(">I", 9)
    video.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.mp4: 9 frames declared, 8 could be read"):
        Video.open(video)

from pathlib import Path

import pytest

from hnerf.capture.footage import Video
from hnerf.errors import InputError
from tests.capture.mp4 import INTERLACED, write_video


def test_interlaced_video_is_refused(tmp_path: Path) -> None:
    """OpenCV decodes it, cannot convert it to RGB, and returns whatever was in memory before."""
    (tmp_path / "a.mp4").write_bytes(INTERLACED)
    with pytest.raises(
        InputError, match=r"a\.mp4: all its pictures look the same; if .* export it as progressive H\.264"
    ):
        Video.open(tmp_path / "a.mp4")


def test_a_video_of_one_picture_or_of_pictures_that_differ_once_is_read(tmp_path: Path) -> None:
    for levels in ([90], [90, 90, 120]):
        write_video(tmp_path / "a.mp4", levels)
        assert len(Video.open(tmp_path / "a.mp4").frames) == len(levels)

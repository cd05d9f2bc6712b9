from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.footage import Video
from hnerf.errors import InputError
from tests.capture.mp4 import (
    INTERLACED,
    LEFT_TO_RIGHT,
    QUARTER_TURN,
    TOP_TO_BOTTOM,
    TRANSPOSED,
    show_as,
    write_video,
)


def test_interlaced_video_is_refused(tmp_path: Path) -> None:
    """OpenCV decodes it, cannot convert it to RGB, and returns whatever was in memory before."""
    (tmp_path / "a.mp4").write_bytes(INTERLACED)
    video = Video.open(tmp_path / "a.mp4")
    with pytest.raises(InputError, match=r"a\.mp4: its pictures look the same; if .* export it as progressive H\.264"):
        list(video.read(video.frames))


def test_a_video_of_one_picture_or_of_pictures_that_differ_once_is_read(tmp_path: Path) -> None:
    for levels in ([90], [90, 90, 120]):
        write_video(tmp_path / "a.mp4", levels)
        assert len(list(Video.open(tmp_path / "a.mp4").read(range(len(levels))))) == len(levels)


def test_a_rotation_in_the_metadata_is_honoured(tmp_path: Path) -> None:
    video = tmp_path / "a.mp4"
    write_video(video, [200, 210, 220])
    show_as(video, QUARTER_TURN)
    upright = next(Video.open(video).read([0])).rgb
    assert upright.shape[:2] == (96, 64)
    assert upright[:40].mean() > 150 and upright[56:].mean() < 20  # the left half is now on top


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize(
    ("matrix", "bright"),
    [
        (LEFT_TO_RIGHT, np.s_[:, :40]),  # the left half of the picture is bright, and stays on the left
        (TOP_TO_BOTTOM, np.s_[:, 56:]),  # a camera held upside down: the picture turned by 180 degrees
        (TRANSPOSED, np.s_[:40]),  # a camera on its side: turned by 90 degrees clockwise
    ],
)
def test_a_mirror_image_in_the_metadata_is_shown_upright_as_the_lens_saw_it(
    tmp_path: Path, matrix: tuple[int, int, int, int], bright: tuple[slice, ...], wide: bool
) -> None:
    video = tmp_path / "a.mp4"
    write_video(video, [200, 210, 220])
    show_as(video, matrix, wide)
    upright = next(Video.open(video).read([0])).rgb
    assert upright[bright].mean() > 150 and upright[::-1, ::-1][bright].mean() < 20

import struct
from pathlib import Path

import pytest

from hnerf.capture.footage import Video
from hnerf.capture.video_metadata import declared_samples, focal_35mm
from hnerf.errors import InputError
from tests.capture.mp4 import declare_samples, write_video

HOSTILE = {
    "no image": ("a.jpg", b"nothing"),
    "an empty image": ("a.png", b""),
    "a box without end": ("a.mp4", struct.pack(">I4sQ", 1, b"free", 2**64 - 1)),
    "a box that is smaller than its head": ("a.mp4", struct.pack(">I4s", 3, b"free")),
    "a box cut short": ("a.mp4", b"\x00\x00\x00\x01moov\x00"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_what_cannot_be_read_states_nothing(case: str, tmp_path: Path) -> None:
    name, content = HOSTILE[case]
    (tmp_path / name).write_bytes(content)
    assert focal_35mm(tmp_path / name) is None


@pytest.mark.parametrize("to_the_end", [False, True])
def test_more_samples_declared_than_there_are_bytes(tmp_path: Path, to_the_end: bool) -> None:
    """FFmpeg's table of a hundred million would take 2.4 GB. The last box may leave its size out."""
    path = tmp_path / "a.mp4"
    write_video(path, [90] * 3)
    assert declared_samples(path) == 0 and len(Video.open(path).frames) == 3
    declare_samples(path, 100_000_000)
    if to_the_end:
        content = path.read_bytes()
        start = content.index(b"moov") - 4
        path.write_bytes(content[:start] + bytes(4) + content[start + 4 :])
    with pytest.raises(InputError, match=r"a\.mp4: declares 100000000 samples in \d+ bytes"):
        Video.open(path)

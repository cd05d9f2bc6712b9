import struct
from pathlib import Path

import pytest

from hnerf.capture.video_metadata import focal_35mm

HOSTILE = {
    "not an image": ("a.jpg", b"nothing"),
    "an empty image": ("a.png", b""),
    "a box of 2^64 - 1 bytes": ("a.mp4", struct.pack(">I4sQ", 1, b"free", 2**64 - 1)),
    "a box that is smaller than its header": ("a.mp4", struct.pack(">I4s", 3, b"free")),
    "a box cut short": ("a.mp4", b"\x00\x00\x00\x01moov\x00"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_unreadable_metadata_give_no_focal_length(case: str, tmp_path: Path) -> None:
    name, content = HOSTILE[case]
    (tmp_path / name).write_bytes(content)
    assert focal_35mm(tmp_path / name) is None

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from hnerf.capture import boxes
from hnerf.capture.footage import Video
from hnerf.errors import InputError
from tests.capture.mp4 import box, declare_samples, trim, write_video


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Return a video of three frames, which is readable as it is."""
    write_video(tmp_path / "a.mp4", [90, 100, 110])
    assert len(Video.open(tmp_path / "a.mp4").frames) == 3
    return tmp_path / "a.mp4"


def split(path: Path) -> tuple[bytes, bytes]:
    """Return the content before a video's last box, moov, and that box, which holds its tables."""
    content = path.read_bytes()
    start = content.index(b"moov") - 4
    return content[:start], content[start:]


@pytest.mark.parametrize(
    "hide",
    [
        lambda frames, moov: frames + moov,
        lambda frames, moov: frames + bytes(4) + moov[4:],  # the last box may omit its size
        lambda frames, moov: frames + moov[:4] + b"free" + moov[8:],  # FFmpeg still reads it as the header
        lambda frames, moov: frames + moov.replace(b"stsz", b"stsz" + bytes(4) + b"stsz"),  # the name twice
    ],
)
def test_more_declared_samples_than_bytes_are_refused(video: Path, hide: Callable[[bytes, bytes], bytes]) -> None:
    """FFmpeg's table of a hundred million samples would take 2.4 GB."""
    declare_samples(video, 100_000_000)
    video.write_bytes(hide(*split(video)))
    with pytest.raises(InputError, match=r"a\.mp4: declares \d{9,} samples in \d+ bytes"):
        Video.open(video)


def test_declared_samples_are_added_up_over_tracks(video: Path) -> None:
    declare_samples(video, 950)
    frames, moov = split(video)
    boxes.check_tables(video)
    video.write_bytes(frames + moov * 20)
    with pytest.raises(InputError, match=r"a\.mp4: declares 19000 samples"):
        boxes.check_tables(video)


def test_more_samples_declared_in_fragments_than_bytes_are_refused(video: Path) -> None:
    """Samples are added up over fragments. Frames may contain any bytes, even those of a fragment."""
    run = box(b"moof", box(b"traf", box(b"trun", struct.pack(">III", 1, 600, 0))))
    video.write_bytes(video.read_bytes() + box(b"mdat", run * 9) + run)
    boxes.check_tables(video)
    video.write_bytes(video.read_bytes() + run * 3)
    with pytest.raises(InputError, match=r"a\.mp4: declares 2400 samples in \d+ bytes"):
        boxes.check_tables(video)


def test_an_edit_list_that_repeats_frames_too_often_is_refused(video: Path) -> None:
    """With so many edits, FFmpeg's table would be a thousand times as large as the file's."""
    write_video(video, [90] * 1000)
    trim(video, *[(0, 1000)] * 300)
    with pytest.raises(InputError, match=r"a\.mp4: repeats its frames in 300 edits; export it again"):
        Video.open(video)


def test_a_compressed_header_is_refused(video: Path) -> None:
    frames, moov = split(video)
    packed = box(b"dcom", b"zlib") + box(b"cmvd", struct.pack(">I", len(moov)) + zlib.compress(moov))
    video.write_bytes(frames + box(b"moov", box(b"cmov", packed)))
    with pytest.raises(InputError, match=r"a\.mp4: its header is compressed; export it again"):
        Video.open(video)


def test_tables_are_read_up_to_a_limit(video: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither frames nor skippable boxes count towards the limit."""
    frames, moov = split(video)
    monkeypatch.setattr(boxes, "MAX_TABLES_BYTES", 1 << 20)
    video.write_bytes(frames + box(b"free", bytes(2 << 20)) + moov)
    assert len(Video.open(video).frames) == 3
    video.write_bytes(frames + box(b"moov", moov[8:] + box(b"free", bytes(1 << 20))))
    with pytest.raises(InputError, match=r"a\.mp4: more than 1 MB of tables beside its frames; export it in shorter"):
        Video.open(video)

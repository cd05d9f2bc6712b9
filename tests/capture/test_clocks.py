"""Synchronised footage: clocks, frame rates, uneven rates."""

import errno
import os
import shutil
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from hnerf.capture.capture import Capture
from hnerf.capture.clocks import Clock, in_step, read_clocks, write_clocks
from hnerf.capture.footage import Video
from hnerf.capture.ingest import ingest
from hnerf.capture.uncalibrated import Uncalibrated
from hnerf.config import CaptureSettings
from hnerf.errors import InputError
from tests.capture.mp4 import hold_frames, write_video
from tests.capture.recordings import HEIGHT, WIDTH, write_easymocap


def recorded(name: str, count: int, fps: float) -> Video:
    """Return a video without time stamps."""
    return Video(Path(name), tuple(range(count)), fps)


def test_instants_are_the_frames_of_the_slowest_camera_by_hand() -> None:
    footage = {"a": recorded("a", 10, 10), "b": recorded("b", 10, 5)}
    found = in_step(footage, {"a": Clock(0.25), "b": Clock(0.0)}, 30)
    # b's frame k shows the instant k / 5 s, when a's clock shows k / 5 + 0.25 s: its frame 2 k + 2.5, up to 9.5.
    assert found["a"].own == pytest.approx({0: 2.5, 1: 4.5, 2: 6.5, 3: 8.5})
    assert found["b"].own == pytest.approx({0: 0, 1: 1, 2: 2, 3: 3})


def test_a_drift_moves_later_frames_and_that_of_the_slowest_camera_is_removed_by_hand() -> None:
    """b drifts by 90 s x 100 ppm = 9 ms in 900 frames of 100 ms. If a's clock is 100 ppm fast, its frame 900 is at 90 /
    1.0001 s, and b has 20 frames a second."""
    for fps, a, b, own in ((10, Clock(), Clock(0.0, 1.0001), 900.09), (20, Clock(0.0, 1.0001), Clock(), 1800 / 1.0001)):
        found = in_step({"a": recorded("a", 1001, 10), "b": recorded("b", 100 * fps + 1, fps)}, {"a": a, "b": b}, 30)
        assert found["b"].own[900] == pytest.approx(own, abs=1e-6)


def test_footage_at_even_rates_without_clocks_is_unchanged() -> None:
    footage = {"a": recorded("a", 10, 10), "b": recorded("b", 10, 10)}
    found = in_step(footage, {}, 30)
    assert {name: one.source for name, one in found.items()} == footage
    assert [one.own for one in found.values()] == [{frame: frame for frame in range(10)}] * 2


def test_missing_images_are_not_replaced_by_images_of_another_time() -> None:
    whole, gap = recorded("a", 20, 10), Video(Path("b"), (*range(5), *range(8, 20)), 10)
    found = in_step({"a": whole, "b": gap}, {"a": Clock(), "b": Clock(0.04)}, 30)
    assert found["a"].frames == (*range(5), *range(8, 20))  # at instant 7, b's nearest image is 0.06 s away


def test_uneven_frames_are_all_used_and_none_replaces_a_dropped_one() -> None:
    video = Video(Path("b"), (0, 1, 2, 3, 4, 5), None, (0.0, 0.1, 0.24, 0.3, 0.6, 0.7))  # two dropped after 0.3 s
    found = in_step({"a": recorded("a", 7, 10), "b": video}, {"a": Clock(), "b": Clock(0.06)}, 30)
    # a's instants 1, 3 and 4 are 0.16, 0.36 and 0.46 s: 0.06, 0.06 and 0.14 s from a frame; 1 is between neighbours
    assert found["b"].own == pytest.approx({0: 0.6, 1: 1 + 6 / 14, 2: 2 + 2 / 6, 5: 3 + 26 / 30, 6: 4.6})


def test_of_equally_slow_cameras_one_with_even_frames_sets_the_instants() -> None:
    video = Video(Path("a"), (0, 1, 2, 3, 4), None, (0.0, 0.1, 0.2, 0.3, 0.6))
    found = in_step({"a": video, "b": recorded("b", 7, 10)}, {}, 30)
    assert found["a"].frames == (0, 1, 2, 3, 6)  # b's numbers; a's frame 4 is at 0.6 s


def test_an_uneven_video_that_sets_the_instants_gets_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    """Of a's 13 frames, six take 0.1 s and six 0.2 s: by an even rate, its frame 6 would be 0.3 s late, at 0.9 s. b has
    20 frames a second."""
    times_s = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8)
    found = in_step({"a": Video(Path("a"), tuple(range(13)), 12 / 1.8, times_s), "b": recorded("b", 37, 20)}, {}, 30)
    assert found["a"].frames == tuple(range(13)) and found["b"].own[7] == pytest.approx(16)
    assert "a: frames come up to 0.3 s off an even rate" in caplog.text


def even_video(name: str, count: int, step_s: float) -> Video:
    return Video(Path(name), tuple(range(count)), 1 / step_s, tuple(step_s * frame for frame in range(count)))


def test_videos_whose_rates_differ_a_little_are_matched_by_time(caplog: pytest.LogCaptureFixture) -> None:
    """Frames of b last 1 % longer, so that its frame 40 is shown at 4.04 s. a's frame k is at k / 10 s, b's frame k /
    1.01. After 40 frames they are 0.04 s apart, after 60 frames 0.06 s, more than half a frame."""
    short = in_step({"a": even_video("a", 41, 0.1), "b": even_video("b", 41, 0.101)}, {}, 30)
    assert short["b"].own == short["a"].own and not caplog.messages
    long = in_step({"a": even_video("a", 61, 0.1), "b": even_video("b", 61, 0.101)}, {}, 30)
    assert long["b"].own == pytest.approx({frame: frame for frame in range(60)})  # b's frame 60 comes after a's last
    assert long["a"].own[50] == pytest.approx(50.5) and long["a"].recorded([58]) == {58: 59}
    assert "a, b: by their time stamps, videos drift apart; images are matched by these" in caplog.text


def test_videos_of_different_lengths_or_rates_are_left_to_be_refused() -> None:
    for other in (even_video("b", 80, 0.1), even_video("b", 80, 0.101), even_video("b", 61, 0.102)):
        found = in_step({"a": even_video("a", 61, 0.1), "b": other}, {}, 30)
        assert [one.frames for one in found.values()] == [tuple(range(61)), other.frames]


def test_recordings_that_do_not_overlap_and_missing_clocks_are_refused() -> None:
    footage = {"a": recorded("a", 10, 10), "b": recorded("b", 10, 10)}
    with pytest.raises(InputError, match="do not overlap"):
        in_step(footage, {"a": Clock(), "b": Clock(5.0)}, 30)
    with pytest.raises(InputError, match="camera b is missing"):
        in_step(footage, {"a": Clock()}, 30)


def test_a_clock_outside_a_cameras_table_is_refused(tmp_path: Path) -> None:
    (tmp_path / "clocks.toml").write_text("offset_s = 1.0\n")
    with pytest.raises(InputError, match=r"clocks\.toml: offset_s is no table"):
        read_clocks(tmp_path)


def test_clocks_are_read_as_written(tmp_path: Path) -> None:
    clocks = {"left": Clock(), "cam 2": Clock(-1.25, 1.0002)}
    write_clocks(tmp_path / "clocks.toml", clocks)
    read = read_clocks(tmp_path)
    assert list(read) == list(clocks) and np.allclose(list(read.values()), list(clocks.values()))
    (tmp_path / "clocks.toml").write_text("[a]\noffset = 1.0\n")
    with pytest.raises(InputError, match=r"clocks\.toml: offset"):
        read_clocks(tmp_path)


def ingested(folder: Path, out: Path) -> Capture:
    return ingest(folder, CaptureSettings(), out, Uncalibrated(folder))


def test_videos_are_ingested_synchronised(tmp_path: Path) -> None:
    folder = tmp_path / "film"
    write_video(folder / "a.mp4", [10 * k for k in range(20)])
    write_video(folder / "b.mp4", [10 * k for k in range(15)])
    with pytest.raises(InputError, match="hnerf synchronise"):
        ingested(folder, tmp_path / "refused")
    (folder / "clocks.toml").write_text("[a]\noffset_s = 0.08\n[b]\n")  # two frames later on a's clock
    capture = ingested(folder, tmp_path / "out")
    assert capture.frames == tuple(range(2, 17))  # a's frames: it is as slow as b and comes first
    levels = [[int(capture.image(name, frame)[20, 20].mean()) for name in "ab"] for frame in (2, 7, 14)]
    assert np.allclose(levels, [[20, 0], [70, 50], [140, 120]], atol=4.5)


def test_frames_at_an_uneven_rate_are_matched_by_time(tmp_path: Path) -> None:
    folder = tmp_path / "film"
    for name in "ab":
        write_video(folder / f"{name}.mp4", [10 * k for k in range(20)])
    hold_frames(folder / "b.mp4", 10, 10)
    times_s = Video.open(folder / "b.mp4").times_s
    assert np.allclose(times_s[8:13], [0.32, 0.36, 0.40, 0.48, 0.56], atol=1e-3)
    capture = ingested(folder, tmp_path / "out")
    level = int(capture.image("b", capture.frames[-1])[20, 20].mean())
    other = int(capture.image("a", capture.frames[-1])[20, 20].mean())
    last_s = 0.04 * round(other / 10)
    assert abs(last_s - times_s[round(level / 10)]) <= 0.041  # half of the longer frame; 0.2 s if matched by number


def test_clocks_that_cannot_be_written_leave_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "replace", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(OSError, match="No space left"):
        write_clocks(tmp_path / "clocks.toml", {"a": Clock()})
    assert not list(tmp_path.iterdir())


def test_the_frame_rate_is_that_of_the_camera_that_sets_the_instants(tmp_path: Path) -> None:
    """The last five of b's 15 frames last twice as long: b has 19 a second on average. a has 25; its frames count."""
    write_video(tmp_path / "film" / "a.mp4", [10 * k for k in range(20)])
    write_video(tmp_path / "film" / "b.mp4", [10 * k for k in range(15)])
    hold_frames(tmp_path / "film" / "b.mp4", 10, 5)
    assert Video.open(tmp_path / "film" / "b.mp4").fps < 20
    assert ingested(tmp_path / "film", tmp_path / "out").fps == pytest.approx(25)


def test_a_stated_rate_must_not_contradict_the_slowest_video(tmp_path: Path) -> None:
    """a has 25 frames a second, b 50: a's frames count. A stated rate can correct only one that all videos share: 25
    may be the rate at which both show what they filmed at 100."""
    folder = tmp_path / "film"
    write_video(folder / "a.mp4", [10 * k for k in range(10)])
    write_video(folder / "b.mp4", [5 * k for k in range(20)], fps=50)
    (folder / "clocks.toml").write_text("[a]\n[b]\n")
    for stated in ("# none\n", "fps = 25\n", "fps = 25.1\n"):
        (folder / "capture.toml").write_text(stated)
        assert ingested(folder, tmp_path / "out").fps == pytest.approx(25)
    (folder / "capture.toml").write_text("fps = 50\n")
    with pytest.raises(InputError, match=r"capture.toml: fps: 50, but .* which has 25 a second; remove the line$"):
        ingested(folder, tmp_path / "out")
    write_video(folder / "b.mp4", [10 * k for k in range(10)])
    (folder / "capture.toml").write_text("fps = 100\n")
    assert ingested(folder, tmp_path / "out").fps == 100


def test_a_stated_rate_applies_to_images_next_to_a_slower_video(tmp_path: Path) -> None:
    """Five images at 50 a second span the same time as three frames of the video at 25."""
    folder = write_easymocap(tmp_path / "film")
    shutil.rmtree(folder / "openpose")
    shutil.rmtree(folder / "images" / "02")
    write_video(folder / "videos" / "02.mp4", [100, 110, 120], size_px=(WIDTH, HEIGHT))
    (folder / "clocks.toml").write_text('["01"]\n["02"]\n')
    (folder / "capture.toml").write_text("fps = 50\n")
    capture = ingest(folder, CaptureSettings(), tmp_path / "out")
    assert (capture.frames, capture.fps) == ((0, 1, 2), 25)


def test_a_single_video_at_an_uneven_rate_gets_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Of 20 frames of 40 ms, the last ten last twice as long: ten take 0.4 s, but at an even rate, 0.6 s."""
    write_video(tmp_path / "film" / "a.mp4", [10 * k for k in range(20)])
    ingest(tmp_path / "film", CaptureSettings(), tmp_path / "even")
    assert "off an even rate" not in caplog.text
    hold_frames(tmp_path / "film" / "a.mp4", 10, 10)
    ingest(tmp_path / "film", CaptureSettings(), tmp_path / "uneven")
    assert "a.mp4: frames come up to 0.2 s off an even rate" in caplog.text

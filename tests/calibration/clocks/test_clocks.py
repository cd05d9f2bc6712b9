"""Camera clocks estimated from keypoints and from sound, compared with known clocks."""

import errno
import os
import tracemalloc
import wave
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from hnerf.calibration.clocks.estimate import _solve, estimate_clocks
from hnerf.calibration.clocks.keypoints import PairClock, Track, _off_together, pair_clock, smoothed
from hnerf.calibration.clocks.sound import read_sound, sound_offset
from hnerf.calibration.matches import fundamental
from hnerf.errors import InputError
from tests.calibration.synthetic import STANDING_M, ring

FPS = 30.0


def wandering_m(instants_s: np.ndarray) -> np.ndarray:
    """Return joints (n, 25, 3) of a figure that wanders, turns and reaches without repeating itself."""
    waves = np.random.default_rng(3).uniform((0.05, 0), (0.6, 2 * np.pi), (12, 2))

    def slow(k: int) -> np.ndarray:
        return np.sum([np.sin(2 * np.pi * hz * instants_s + phase) for hz, phase in waves[3 * k : 3 * k + 3]], axis=0)

    points = np.repeat(STANDING_M[None], len(instants_s), axis=0)
    points[:, [3, 4], 0] += 0.15 * slow(0)[:, None]
    points[:, [6, 7], 2] += 0.15 * slow(1)[:, None]
    turn, c, s = slow(2), np.cos(slow(2)), np.sin(slow(2))
    points[..., 0], points[..., 1] = (
        c[:, None] * points[..., 0] - s[:, None] * points[..., 1],
        s[:, None] * points[..., 0] + c[:, None] * points[..., 1],
    )
    points[..., :2] += np.stack([0.3 * slow(3), 0.2 * turn], -1)[:, None]
    return points


def filmed(index: int, seconds: float, offset_s: float, drift: float = 0.0, fps: float = FPS) -> Track:
    """Return the track that camera `index` of a ring sees; its clock shows (1 + drift) t + offset_s."""
    own_s = np.arange(int(seconds * fps)) / fps
    camera = ring(4)[index]
    uv = camera.project(wandering_m((own_s - offset_s) / (1 + drift)))[0]
    uv = uv + np.random.default_rng(index).normal(size=uv.shape) * 4  # px, of a person 500 px tall
    return Track(own_s, np.concatenate([uv, np.full_like(uv[..., :1], 0.8)], -1))


def test_offsets_of_many_frames_or_a_fraction_are_found_at_different_frame_rates() -> None:
    true_s = {"c0": 0.0, "c1": 37 / FPS, "c2": -11.37 / FPS, "c3": 20.6 / FPS}
    tracks = {
        name: filmed(i, 4.0, offset, fps=25.0 if i == 3 else FPS) for i, (name, offset) in enumerate(true_s.items())
    }
    found = estimate_clocks(tracks)
    for name, offset in true_s.items():
        assert found.clocks[name].offset_s == pytest.approx(offset, abs=0.1 / FPS)
        assert found.clocks[name].rate == 1.0


def test_solving_a_chain_of_pairwise_clocks_by_hand() -> None:
    """b = a + 1 +- 0.1 and c = 1.5 b + 2 +- 0.2: 3.5, and an error of sqrt((1.5 x 0.1)^2 + 0.2^2) = 0.25."""
    pairs = [("a", "b"), ("b", "c")]
    differences, errors = dict(zip(pairs, (1.0, 2.0), strict=True)), dict(zip(pairs, (0.1, 0.2), strict=True))
    x, error = _solve(["a", "b", "c"], differences, errors, {("b", "c"): 1.5})
    np.testing.assert_allclose(x, [0, 1, 3.5])
    np.testing.assert_allclose(error, [0, 0.1, 0.25])


def test_a_pair_that_contradicts_the_others_gets_little_weight() -> None:
    """d is 3 later than a by way of b or c, but 4 later directly, which is a hundred standard errors off."""
    differences = {("a", "b"): 1.0, ("a", "c"): 2.0, ("a", "d"): 4.0, ("b", "c"): 1.0, ("b", "d"): 2.0, ("c", "d"): 1.0}
    x, _ = _solve(list("abcd"), differences, dict.fromkeys(differences, 0.01), {})
    np.testing.assert_allclose(x, [0, 1, 2, 3], atol=0.01)


def test_a_precise_drift_outweighs_pairs_too_short_to_measure_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """b drifts by 400 +- 10 ppm against a. c recorded too briefly: 0 +- 100 ppm against both. Least squares put c
    halfway, and (b - 400)^2 / 10^2 + 2 (b / 2)^2 / 100^2 is least at b = 400 / 1.005."""
    short = pair_clock(smoothed(filmed(0, 5, 0.0)), smoothed(filmed(2, 5, 0.5)))
    assert (short.rate, short.rate_error) == (1.0, pytest.approx(1e-4))
    drifting = short._replace(offset_s=0.0, rate=1 + 4e-4, rate_error=1e-5)
    monkeypatch.setattr("hnerf.calibration.clocks.estimate.smoothed", lambda track: track)
    monkeypatch.setattr(
        "hnerf.calibration.clocks.estimate.pair_clock", lambda a, b, *_: drifting if a + b == "ab" else short
    )
    found = estimate_clocks({name: name for name in "abc"})
    assert 1e6 * (found.clocks["b"].rate - 1) == pytest.approx(398, abs=1)
    assert 1e6 * (found.clocks["c"].rate - 1) == pytest.approx(199, abs=1)


def test_a_short_recording_with_a_guessed_clock_rate_is_synchronised_while_it_lasts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """b drifts by 100 ppm against a. c recorded for only 20 s, around 570 s by a's clock, when b's clock showed
    570.057 s and its own 10 s. Whatever rate c is given, it must show 10 s at 570 s."""
    pairs = {
        "ab": PairClock(0.0, 1 + 1e-4, 300.0, 5e-4, 2e-6),
        "ac": PairClock(-560.0, 1.0, 570.0, 1e-3, 1e-4),
        "bc": PairClock(-560.057, 1.0, 570.057, 1e-3, 1e-4),
    }
    monkeypatch.setattr("hnerf.calibration.clocks.estimate.smoothed", lambda track: track)
    monkeypatch.setattr("hnerf.calibration.clocks.estimate.pair_clock", lambda a, b, *_: pairs[a + b])
    found = estimate_clocks({name: name for name in "abc"}).clocks
    assert 570 * found["b"].rate + found["b"].offset_s == pytest.approx(570.057, abs=1e-4)
    assert 570 * found["c"].rate + found["c"].offset_s == pytest.approx(10, abs=1e-4)


def test_a_drift_of_200_ppm_in_ten_minutes() -> None:
    tracks = filmed(0, 600, 0.0, fps=10), filmed(1, 600, 12.34, 2e-4, fps=10)
    found = pair_clock(*(smoothed(Track(times_s, keypoints[:, ::4])) for times_s, keypoints in tracks))
    assert 1e6 * (found.rate - 1) == pytest.approx(200, abs=10)
    assert found.offset_s == pytest.approx(12.34, abs=0.1 / FPS)


def test_a_long_recording_is_refined_to_the_frames_that_a_short_one_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 60 seconds, 60 frames are used: 1 of the 1.2 that both recorded if from all, 11 if from the 6.2 seconds that
    the offset can reach."""
    monkeypatch.setattr("hnerf.calibration.clocks.keypoints.MAX_REFINED", 60)
    long, short = (
        smoothed(filmed(index, seconds, offset_s)) for index, seconds, offset_s in ((0, 60, 0), (1, 1.2, -30))
    )
    found = pair_clock(long, short, fundamental(*ring(4)[:2]), -30.1)
    assert found.offset_s == pytest.approx(-30, abs=0.2 / FPS)


def test_known_cameras_tell_apart_the_steps_of_an_even_walk() -> None:
    def walk(index: int, offset_s: float) -> Track:
        own_s = np.arange(120) / FPS
        angle = 1.5 * (own_s - offset_s)
        pose = np.repeat(STANDING_M[None], len(own_s), axis=0)
        pose[:, [3, 4, 6, 7], 0] += 0.25 * np.sin(5 * (own_s - offset_s))[:, None] * np.array([1, 1, -1, -1])
        x, y = pose[..., 0].copy(), pose[..., 1] + 0.5
        c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
        pose[..., 0], pose[..., 1] = c * x - s * y, s * x + c * y
        uv = ring(4)[index].project(pose)[0] + np.random.default_rng(index).normal(size=(120, 25, 2)) * 4
        return Track(own_s, np.concatenate([uv, np.full_like(uv[..., :1], 0.8)], -1))

    a, b = smoothed(walk(0, 0.0)), smoothed(walk(1, 0.41))
    with pytest.raises(InputError, match="walks evenly on"):
        pair_clock(a, b)  # one step later, from a camera further around, looks the same
    found = pair_clock(a, b, fundamental(*ring(4)[:2]))
    assert found.offset_s == pytest.approx(0.41, abs=0.1 / FPS)


def test_smoothing_reproduces_a_parabola_by_hand() -> None:
    times_s = np.arange(9) / 10
    keypoints = np.ones((9, 25, 3))
    keypoints[..., 0] = (10 + 3 * times_s + 2 * times_s**2)[:, None]
    keypoints[..., 1] = np.arange(25)
    path = smoothed(Track(times_s, keypoints))
    place, velocity, known = path.at(np.array([0.42]))
    x = (place[0, 0, 0] - path.to_unit[0, 2]) / path.to_unit[0, 0]
    assert known.all() and x == pytest.approx(10 + 3 * 0.42 + 2 * 0.42**2)
    assert velocity[0, 0, 0] / path.to_unit[0, 0] == pytest.approx(3 + 4 * 0.42)


def test_detections_smoothed_together_count_as_one() -> None:
    """Smoothing takes a tenth of a second on each side: 7 frames at 30 a second, 25 at 120. At 10 it takes two on each
    side; these 5 frames last as long as 15 at 30 a second. Then every second or tenth frame is used."""
    at_30, at_120, at_10 = (smoothed(filmed(0, 20.0, 0.0, fps=fps)) for fps in (30.0, 120.0, 10.0))
    pairs = (at_30, at_30, 1), (at_120, at_120, 1), (at_30, at_10, 1), (at_30, at_30, 0.5), (at_30, at_30, 0.1)
    assert [_off_together(*pair) for pair in pairs] == pytest.approx([7, 25, 15, 3.5, 1])


def test_the_clock_error_grows_with_the_number_of_detections_smoothed_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """With 28 detections instead of 7, four times as many, the error doubles."""
    a, b = smoothed(filmed(0, 6.0, 0.0)), smoothed(filmed(1, 6.0, 0.4))
    error_s = pair_clock(a, b).error_s
    monkeypatch.setattr("hnerf.calibration.clocks.keypoints._off_together", lambda *_: 28.0)
    assert pair_clock(a, b).error_s == pytest.approx(2 * error_s)


def test_one_camera_or_a_person_who_does_not_move_is_refused() -> None:
    with pytest.raises(InputError, match="nothing to be synchronised with"):
        estimate_clocks({"c0": filmed(0, 4.0, 0.0)})
    still = {f"c{i}": Track(np.arange(90) / FPS, np.repeat(filmed(i, 3, 0.0).keypoints[:1], 90, 0)) for i in (0, 1)}
    with pytest.raises(InputError, match="camera c1: no start offset is clearly better than all others"):
        estimate_clocks(still)


def test_a_camera_that_never_shows_the_person_is_named() -> None:
    seen, unseen = filmed(0, 1.0, 0.0), filmed(1, 1.0, 0.0)
    unseen.keypoints[..., 2] = 0
    with pytest.raises(InputError, match=r"^camera c1: the person is seen in fewer than three frames"):
        estimate_clocks({"c0": seen, "c1": unseen})


def test_recordings_that_do_not_overlap_by_their_sound_are_refused_for_that_reason() -> None:
    a, b = smoothed(filmed(0, 2.0, 0.0)), smoothed(filmed(1, 2.0, 0.4))
    with pytest.raises(InputError, match=r"\+5\.0 s apart, as their sound has them, share fewer than 100 keypoints"):
        pair_clock(a, b, near_s=5.0)


def heard(rng: np.random.Generator, dry: np.ndarray, delay: int) -> np.ndarray:
    """Return a dry sound delayed by `delay` samples, with noise and 30 random echoes of a room, which together are as
    loud as the sound and decay by 60 dB in 0.4 s."""
    response = np.zeros(4000)
    response[0] = 1
    echoes = rng.integers(50, 4000, 30)
    response[echoes] = rng.normal(size=30) * np.exp(-echoes / 930)
    response[1:] /= np.linalg.norm(response[1:])
    wet = np.convolve(dry, response)
    return np.concatenate([np.zeros(delay), wet]) + rng.normal(size=delay + len(wet)) * 0.1 * dry.std()


@pytest.mark.parametrize("kind", ["claps", "speech"])
def test_the_offset_of_echoing_sound_is_found_within_two_milliseconds(kind: str) -> None:
    rng = np.random.default_rng(0)
    dry = rng.normal(size=16_000 * 6)
    if kind == "claps":
        starts = rng.integers(0, len(dry) - 2000, 5)
        dry = sum(np.roll(dry * np.exp(-np.arange(len(dry)) / 80), start) for start in starts)
    else:  # syllables: noise in bands, three a second
        dry = np.convolve(dry, np.hanning(9), "same") * np.abs(np.sin(3 * np.pi * np.arange(len(dry)) / 16_000)) ** 3
    a, b = heard(rng, dry, 1_000), heard(rng, dry, 20_733)
    assert sound_offset(a, b) == pytest.approx(19_733 / 16_000, abs=0.002)
    assert sound_offset(b, a) == pytest.approx(-19_733 / 16_000, abs=0.002)


def test_long_recordings_of_sound_fit_into_memory() -> None:
    """With single precision and few copies, two recordings of 40 minutes need 3 GB."""
    rng = np.random.default_rng(2)
    a = rng.normal(size=520_000).astype(np.float32)
    b = np.roll(a, 5_000) + rng.normal(size=len(a)).astype(np.float32)
    tracemalloc.start()
    try:
        assert sound_offset(a, b) == 5_000 / 16_000
        assert tracemalloc.get_traced_memory()[1] < 20 * (1 << 20)  # bytes, for each of the 2^20 samples of both
    finally:
        tracemalloc.stop()


def test_unrelated_sound_gives_no_offset() -> None:
    rng = np.random.default_rng(1)
    assert sound_offset(rng.normal(size=50_000), rng.normal(size=60_000)) is None


def write_sound(folder: Path, samples: bytes, rate_hz: int = 16_000, channels: int = 1) -> None:
    """Write 16-bit sound as a.wav."""
    with wave.open(str(folder / "a.wav"), "wb") as file:
        file.setparams((channels, 2, rate_hz, 0, "NONE", "none"))
        file.writeframes(samples)


def test_silence_and_a_click_give_no_offset(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).normal(size=50_000)
    assert sound_offset(noise, np.zeros(50_000)) is None and sound_offset(np.zeros(50_000), np.zeros(50_000)) is None
    assert sound_offset(noise, noise[:300]) is None and sound_offset(noise[:300], noise[:300]) is None
    write_sound(tmp_path, b"\1\0", 48_000)
    sound = read_sound(tmp_path / "a.mp4")
    assert sound is not None and len(sound) == 1


def test_a_wave_file_next_to_a_video_is_read_at_any_sample_rate(tmp_path: Path) -> None:
    tone = (1000 * np.sin(2 * np.pi * 440 * np.arange(48_000) / 48_000)).astype("<i2")
    write_sound(tmp_path, np.repeat(tone, 2).tobytes(), 48_000, channels=2)
    (tmp_path / "a.wav").rename(tmp_path / "a.WAV")  # as recorders name it
    sound = read_sound(tmp_path / "a.mp4")
    (tmp_path / "a.WAV").rename(tmp_path / "a.wav")
    assert sound is not None and len(sound) == 16_000
    assert np.allclose(sound, 1000 * np.sin(2 * np.pi * 440 * np.arange(16_000) / 16_000), atol=2)
    write_sound(tmp_path, b"")
    with pytest.raises(InputError, match=r"a\.wav: holds no sound"):
        read_sound(tmp_path / "a.mp4")
    (tmp_path / "a.wav").write_bytes(b"RIFF")
    with pytest.raises(InputError, match=r"a\.wav: not a readable"):
        read_sound(tmp_path / "a.mp4")


def test_a_malformed_or_linked_wave_file_is_refused(tmp_path: Path) -> None:
    """Bytes 16 to 19 are the size of the format chunk."""
    write_sound(tmp_path, bytes(20))
    with (tmp_path / "a.wav").open("r+b") as raw:
        raw.seek(16)
        raw.write((500).to_bytes(4, "little"))
    with pytest.raises(InputError, match=r"a\.wav: not a readable \.wav"):
        read_sound(tmp_path / "a.mp4")
    (tmp_path / "a.wav").rename(tmp_path / "b.wav")
    (tmp_path / "a.wav").symlink_to("b.wav")
    with pytest.raises(InputError, match=r"a\.wav: is a symbolic link"):
        read_sound(tmp_path / "a.mp4")


def test_a_wave_file_that_cannot_be_reached_is_not_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stale share says nothing about the file, which a later try may read."""
    write_sound(tmp_path, bytes(20))
    monkeypatch.setattr(wave, "open", Mock(side_effect=OSError(errno.ESTALE, os.strerror(errno.ESTALE))))
    with pytest.raises(OSError, match="Stale file handle"):
        read_sound(tmp_path / "a.mp4")


@pytest.mark.parametrize(
    ("says", "warned"),
    [
        ("Output file #0 does not contain any stream", []),
        ("moov atom not found\na.mp4: Invalid data", ["a.mp4: its sound is not used (ffmpeg: a.mp4: Invalid data)"]),
    ],
)
def test_sound_that_ffmpeg_cannot_read_is_noted(
    says: str, warned: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A video without sound is usual."""
    (tmp_path / "ffmpeg").write_text(f"#!/bin/sh\necho '{says}' >&2\nexit 1\n")
    (tmp_path / "ffmpeg").chmod(0o755)
    (tmp_path / "a.mp4").touch()
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    assert read_sound(tmp_path / "a.mp4") is None
    assert [record.getMessage().removeprefix(f"{tmp_path}/") for record in caplog.records] == warned

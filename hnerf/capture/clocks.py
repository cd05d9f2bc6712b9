"""Synchronised footage of cameras that started at different times, record at different rates or have drifting clocks.

`clocks.toml` in the capture's folder gives each camera's own time as a function of the common time t:
t_own = (1 + drift_ppm / 10^6) t + offset_s.
"""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from hnerf.capture.footage import Footage, Video, VideoFrame
from hnerf.capture.safe_io import path_in_capture, read_toml
from hnerf.capture.timing import resample
from hnerf.config import validated
from hnerf.errors import InputError
from hnerf.files import replace_text

FILE = "clocks.toml"
IRREGULAR = 0.5  # of a frame's duration: how far a video's frames may be off an even rate
RATE_TOLERANCE = 0.01  # between frame rates that count as the same, as a share
NOTICED_S = 0.1  # deviation from an even rate beyond which motion looks too fast or too slow

log = logging.getLogger("hnerf.capture")


class Clock(NamedTuple):
    """A camera's clock: it shows rate * t + offset_s at the instant t, in seconds."""

    offset_s: float = 0.0
    rate: float = 1.0


class _ClockTable(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    offset_s: float = 0.0
    drift_ppm: float = Field(default=0.0, gt=-100_000, lt=100_000)


@dataclass(frozen=True)
class InStep:
    """Footage of one camera at the common instants, which are frame numbers of the slowest camera. own: the camera's
    own fractional frame number at each instant; fps: of the slowest camera, if its file states it."""

    source: Footage
    own: dict[int, float]
    fps: float | None

    @property
    def path(self) -> Path:
        """Return the path of the footage."""
        return self.source.path

    @property
    def frames(self) -> tuple[int, ...]:
        """Return the instants, ascending."""
        return tuple(sorted(self.own))

    def recorded(self, instants: Iterable[int]) -> dict[int, int]:
        """Return the camera's own frame that is nearest to each of the instants."""
        frames = np.asarray(self.source.frames)
        return {instant: int(frames[np.abs(frames - self.own[instant]).argmin()]) for instant in instants}

    def read(self, wanted: Iterable[int]) -> Iterator[VideoFrame]:
        """Yield the images nearest to the wanted instants, in ascending order. Raises InputError as the footage
        does."""
        nearest = self.recorded(sorted(wanted))
        images = self.source.read(set(nearest.values()))
        for image, (_, instants) in zip(images, groupby(nearest, nearest.__getitem__), strict=True):
            for instant in instants:
                yield VideoFrame(instant, image.rgb, image.file)

    def resampled(self, people: np.ndarray) -> np.ndarray:
        """Return keypoints (own frames, people, K, 3) at the instants, interpolated between frames."""
        return resample(people, self.source.frames, np.array([self.own[instant] for instant in self.frames]))


def read_clocks(folder: Path) -> dict[str, Clock]:
    """Return the clocks of `clocks.toml` by camera; empty without that file. Raises InputError on a bad value."""
    path = path_in_capture(folder, FILE)
    if not path.exists():
        return {}
    tree = read_toml(path)
    if strays := [key for key, table in tree.items() if not isinstance(table, dict)]:
        raise InputError(f"{path}: {strays[0][:80]} is no table; write it under the name of a camera, as [camera]")
    tables = {name: validated(_ClockTable, table, path) for name, table in tree.items()}
    return {name: Clock(table.offset_s, 1 + 1e-6 * table.drift_ppm) for name, table in tables.items()}


def write_clocks(path: Path, clocks: Mapping[str, Clock]) -> None:
    """Write `clocks.toml`."""
    tables = (
        f'["{name}"]\noffset_s = {clock.offset_s:.5f}\ndrift_ppm = {1e6 * (clock.rate - 1):.1f}\n'
        for name, clock in clocks.items()
    )
    replace_text(path, "# a camera's own time: (1 + drift_ppm / 1e6) t + offset_s\n\n" + "\n".join(tables))


def in_step(footage: dict[str, Footage], clocks: Mapping[str, Clock], fps: float) -> dict[str, InStep]:
    """Return the footage of all cameras at common instants: the frames of the slowest camera that all cameras recorded.
    Of equally slow cameras, the first with evenly spaced frames is taken, so that its frame numbers tell the time.

    If there are no clocks, and the videos' time stamps are evenly spaced and do not drift apart, each camera's instants
    are its own frames. fps: of images without a rate of their own. Raises InputError if a clock is missing or the
    recordings do not overlap.
    """
    times_s = {name: frame_times_s(one, fps) for name, one in footage.items()}
    stamped_s = [times_s[name] for name, one in footage.items() if isinstance(one, Video) and one.times_s]
    drifting = _drift_apart(stamped_s)
    if not clocks and (len(footage) == 1 or not (drifting or any(not _regular(stamps) for stamps in stamped_s))):
        return {name: InStep(one, {frame: frame for frame in one.frames}, one.fps) for name, one in footage.items()}
    if not clocks:
        log.warning(
            "%s: by their time stamps, %s; images are matched by these, not by number (without %s, all cameras are "
            "taken to start at once)",
            ", ".join(one.path.name for one in footage.values()),
            "videos drift apart" if drifting else "frames of a video are unevenly spaced",
            FILE,
        )
    clocks = clocks or dict.fromkeys(footage, Clock())
    if missing := sorted(set(footage).difference(clocks)):
        raise InputError(f"{FILE}: camera {missing[0]} is missing; run `hnerf synchronise` again, or add it")
    slowest = max(footage, key=lambda name: (round(_step_s(times_s[name]), 4), _regular(times_s[name])))
    instants_s = (times_s[slowest] - clocks[slowest].offset_s) / clocks[slowest].rate
    warn_if_uneven(footage[slowest])
    own = {
        name: _frames_at(np.asarray(one.frames), times_s[name], clocks[name].rate * instants_s + clocks[name].offset_s)
        for name, one in footage.items()
    }
    shared = np.isfinite(np.stack(list(own.values()))).all(0)
    if not shared.any():
        raise InputError(f"{FILE}: by these clocks the recordings of {', '.join(footage)} do not overlap; correct it")
    numbers = np.asarray(footage[slowest].frames)[shared]
    return {
        name: InStep(one, dict(zip(numbers.tolist(), own[name][shared].tolist(), strict=True)), footage[slowest].fps)
        for name, one in footage.items()
    }


def warn_if_uneven(one: Footage) -> None:
    """Warn if the frames of a video, which are treated as evenly spaced, are not."""
    if isinstance(one, Video) and one.times_s and (off_s := _unevenness_s(np.asarray(one.times_s))) > NOTICED_S:
        log.warning(
            "%s: frames come up to %.1f s off an even rate, which is assumed, so motion is too fast or too slow in "
            "places; convert the video to a constant rate",
            one.path,
            off_s,
        )


def frame_times_s(footage: Footage, fps: float) -> np.ndarray:
    """Return when each frame was recorded, in seconds on the camera's own clock: as a video states, else at an even
    rate."""
    if isinstance(footage, Video) and footage.times_s:
        return np.asarray(footage.times_s)
    return np.asarray(footage.frames) / (footage.fps or fps)


def _step_s(times_s: np.ndarray) -> float:
    return float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0


def _regular(times_s: np.ndarray) -> bool:
    return _unevenness_s(times_s) <= IRREGULAR * max(_step_s(times_s), 1e-9)


def _drift_apart(times_s: Sequence[np.ndarray]) -> bool:
    """Return whether videos of equally many frames, at rates that count as the same, end more than half a frame apart,
    as those of 29.97 and 30 frames a second do within 17 s."""
    if len({len(stamps) for stamps in times_s}) != 1:
        return False
    lasts_s = np.array([stamps[-1] - stamps[0] for stamps in times_s])
    apart_s = np.ptp(lasts_s)
    return bool(IRREGULAR * _step_s(times_s[0]) < apart_s <= RATE_TOLERANCE * lasts_s.max())


def _unevenness_s(times_s: np.ndarray) -> float:
    even = np.linspace(times_s[0], times_s[-1], len(times_s))
    return float(np.abs(times_s - even).max())


def _frames_at(frames: np.ndarray, times_s: np.ndarray, wanted_s: np.ndarray) -> np.ndarray:
    """Return the fractional frame numbers at given times; NaN more than half a frame from the nearest frame: before the
    first, after the last, and where frames are missing."""
    step_s, position = _step_s(times_s), np.interp(wanted_s, times_s, np.arange(len(times_s)))
    before_s, after_s = (times_s[rounded(position).astype(int)] for rounded in (np.floor, np.ceil))
    off_s = np.minimum(np.abs(wanted_s - before_s), np.abs(wanted_s - after_s))
    neighbours = (after_s > before_s) & (after_s - before_s <= (1 + IRREGULAR) * step_s)
    return np.where(neighbours | (off_s <= step_s / 2), np.interp(wanted_s, times_s, frames), np.nan)

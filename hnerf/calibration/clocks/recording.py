"""Synchronisation of the recordings in a capture's folder: keypoints and sound of each camera, and their clocks."""

import logging
import tempfile
from itertools import combinations
from pathlib import Path

import numpy as np

from hnerf.calibration.clocks.estimate import Clocks, estimate_clocks
from hnerf.calibration.clocks.keypoints import Track
from hnerf.calibration.clocks.sound import read_sound, sound_offset
from hnerf.capture.clocks import frame_times_s
from hnerf.capture.footage import Video
from hnerf.capture.formats.layout import Layout
from hnerf.capture.ingest import DEFAULT_FPS, has_calibration, ingest, lens_as_recorded, recognise
from hnerf.capture.lens import Lens, undistort_keypoints
from hnerf.capture.manifest import read_manifest
from hnerf.capture.subject import subject_keypoints
from hnerf.capture.uncalibrated import Uncalibrated, cameras_without_calibration
from hnerf.config import CaptureSettings
from hnerf.detection.detect import with_keypoints
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera

MAX_FRAMES = 20_000  # of a camera: eleven minutes at 30 frames a second; of more, every second or third is used

log = logging.getLogger("hnerf.calibration")


class UndeterminedClocksError(InputError):
    """The person's motion does not determine the clocks of recordings that can be read."""


def synchronise_recording(folder: Path) -> tuple[Clocks, dict[str, str]]:
    """Return the clocks of the cameras in a folder, and per camera their source, in words.

    Each camera is read separately, with its own frames and times. If the folder has a calibration, the cameras'
    geometry distinguishes offsets that would otherwise look alike. Raises UndeterminedClocksError, and InputError if
    the recordings cannot be read or are not of the calibrated size.
    """
    names = cameras_without_calibration(folder)
    if not names:
        raise InputError(f"{folder}: no images/<camera>/, videos/*.mp4 or *.mp4 to synchronise; add the recordings")
    fps = read_manifest(folder).fps or DEFAULT_FPS
    layout, lenses = _calibration(folder, names)
    tracks, sounds = dict[str, Track](), dict[str, np.ndarray]()
    for name in names:
        alone = Uncalibrated(folder, only=name, calibrated=layout)
        footage = alone.footage(name)
        if name in lenses:
            lenses[name] = lens_as_recorded(lenses[name], footage, footage.frames)[0]
        with tempfile.TemporaryDirectory(prefix="hnerf-") as scratch:
            tracks[name] = _track(alone, name, fps, lenses.get(name), Path(scratch))
        sound = read_sound(footage.path) if isinstance(footage, Video) else None
        if sound is not None:
            sounds[name] = sound
    apart_s = {(a, b): sound_offset(sounds[a], sounds[b]) for a, b in combinations(sounds, 2)}
    near_s = {pair: offset_s for pair, offset_s in apart_s.items() if offset_s is not None}
    heard = {name for pair in near_s for name in pair}
    sources = {name: "keypoints and sound" if name in heard else "keypoints" for name in names}
    cameras = {name: Camera(name, lens.K, lens.R, lens.t_m, 1, 1) for name, lens in lenses.items()}
    try:
        return estimate_clocks(tracks, cameras or None, near_s), sources
    except InputError as error:
        raise UndeterminedClocksError(f"{folder}: {error}") from None


def _track(alone: Uncalibrated, name: str, fps: float, lens: Lens | None, scratch: Path) -> Track:
    """Return the subject's keypoints in all frames of one camera, in recorded pixels, undistorted if the lens is
    known."""
    settings = CaptureSettings(max_frames=MAX_FRAMES)
    capture = with_keypoints(ingest(alone.folder, settings, scratch / "capture", alone), scratch / "detected")
    keypoints = subject_keypoints(capture)[name]
    scale = np.array(capture.recorded_sizes_px[name]) / capture.cameras[name].size_px
    keypoints[..., :2] = keypoints[..., :2] * scale + (scale - 1) / 2
    if lens is not None and name not in capture.recorded_lenses:  # else ingestion undistorted them
        keypoints = undistort_keypoints(keypoints, lens)
    footage = alone.footage(name)
    rows = np.searchsorted(footage.frames, capture.frames)
    return Track(frame_times_s(footage, fps)[rows], keypoints)


def _calibration(folder: Path, names: list[str]) -> tuple[Layout | None, dict[str, Lens]]:
    """Return the layout of the folder with its calibration, and its lenses; neither if there is no calibration or, with
    a warning, if it cannot be read or lacks a camera."""
    if not has_calibration(folder):
        return None, {}
    try:
        layout = recognise(folder)
        lenses = layout.lenses()
    except InputError as error:
        log.warning("%s; clocks are found without a calibration", error)
        return None, {}
    if missing := sorted(set(names).difference(lenses)):
        log.warning("%s: its calibration lacks camera %s; clocks are found without it", folder, ", ".join(missing))
        return None, {}
    return layout, lenses

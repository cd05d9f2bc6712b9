"""Calibration from the person in a folder of images or videos: ingestion, keypoints, cameras."""

import dataclasses
import tempfile
from collections.abc import Mapping
from pathlib import Path

from hnerf.calibration.person.calibrate import PersonCalibration, calibrate_from_person
from hnerf.capture.clocks import Clock
from hnerf.capture.ingest import ingest
from hnerf.capture.manifest import read_manifest
from hnerf.capture.uncalibrated import Uncalibrated, cameras_without_calibration
from hnerf.config import CaptureSettings
from hnerf.detection.detect import with_keypoints
from hnerf.errors import InputError


def calibrate_recording(
    folder: Path,
    height_m: float | None = None,
    lens_file: Path | None = None,
    fov_deg: float | None = None,
    clocks: Mapping[str, Clock] | None = None,
) -> PersonCalibration:
    """Calibrate the cameras of a recording from its own keypoints, or from the network's if it has none.

    An existing calibration of the folder is not read, except for intrinsics in its `intri.yml` that no earlier
    calibration from the person estimated. fov_deg: None for that of `capture.toml`; clocks: used instead of those in
    the folder. Raises InputError if the recording cannot be read or does not determine the cameras.
    """
    if not cameras_without_calibration(folder):
        raise InputError(f"{folder}: no images/<camera>/, videos/*.mp4 or *.mp4 to calibrate from; add the recordings")
    fov_deg = fov_deg or read_manifest(folder).field_of_view_deg
    layout = Uncalibrated(folder, lens_file, fov_deg, found_clocks=clocks)
    with tempfile.TemporaryDirectory(prefix="hnerf-") as scratch:
        capture = ingest(folder, CaptureSettings(), Path(scratch) / "capture", layout)
        capture = with_keypoints(capture, Path(scratch) / "detected")
        known = layout.known_lenses
        sources = {name: one.source for name, one in known.items()}
        unknown = [name for name, source in sources.items() if not source]
        found = calibrate_from_person(capture, unknown, sources, height_m or capture.stature_m)
    lenses = [dataclasses.replace(lens, estimated=known[lens.name].lens.estimated) for lens in found.lenses]
    return dataclasses.replace(found, lenses=lenses)

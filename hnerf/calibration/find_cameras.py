"""Clocks and cameras of a recording that has no calibration, from the person it shows."""

import logging
from pathlib import Path

from hnerf.calibration.clocks.recording import synchronise_recording
from hnerf.calibration.person.recording import calibrate_recording
from hnerf.capture.clocks import FILE, Clock, read_clocks, write_clocks
from hnerf.capture.manifest import read_manifest
from hnerf.capture.safe_io import path_in_capture
from hnerf.capture.uncalibrated import Uncalibrated, cameras_without_calibration
from hnerf.errors import InputError

log = logging.getLogger("hnerf.calibration")


def find_cameras(folder: Path, out: Path) -> None:
    """Write `intri.yml`, `extri.yml` and `report.json` of a recording by several cameras into `out`, and `clocks.toml`
    unless the cameras are in step.

    Images of the same number show the same moment; videos may have started at any time. Clocks and lenses that the
    folder states are used. Raises InputError if the recording does not determine the rest.
    """
    clocks = read_clocks(folder)
    if not clocks and not recorded_as_images(folder):
        clocks = found_clocks(folder)
    if clocks:
        out.mkdir(parents=True, exist_ok=True)
        write_clocks(out / FILE, clocks)
    found = calibrate_recording(folder, fov_deg=read_manifest(folder).field_of_view_deg, clocks=clocks)
    found.save(out)
    log.warning("%s: no calibration, so cameras were found from the person; %s", folder, "; ".join(found.notes()))


def recorded_as_images(folder: Path) -> bool:
    """Return whether the cameras are folders of images."""
    return path_in_capture(folder, "images", cameras_without_calibration(folder)[0]).is_dir()


def found_clocks(folder: Path) -> dict[str, Clock]:
    """Return the clocks of a folder of videos; empty, with a warning, if they cannot be found and all videos have the
    same frames, as those of cameras in step have. Raises InputError that says how to state clocks otherwise."""
    try:
        found = synchronise_recording(folder)[0].clocks
    except InputError as error:
        if not has_equal_frames(folder):
            raise InputError(f"{error}; or state the clocks in {FILE} (docs/formats.md)") from None
        log.warning("%s; cameras are taken to be in step, since their videos have the same frames", error)
        return {}
    for name, clock in found.items():
        log.info("camera %s: starts %+.3f s, drifts %+.0f ppm", name, clock.offset_s, 1e6 * (clock.rate - 1))
    return found


def has_equal_frames(folder: Path) -> bool:
    """Return whether all videos have the same number of frames at the same rate."""
    layout = Uncalibrated(folder)
    footage = [layout.footage(name) for name in cameras_without_calibration(folder)]
    return len({(one.frames, one.fps and round(one.fps, 2)) for one in footage}) == 1

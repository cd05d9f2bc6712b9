"""Clocks and cameras of a recording that has no calibration, from the person it shows."""

import logging
from pathlib import Path

from hnerf.calibration.clocks.recording import UndeterminedClocksError, synchronise_recording
from hnerf.calibration.person.recording import calibrate_recording
from hnerf.capture.clocks import FILE, RATE_TOLERANCE, Clock, read_clocks, write_clocks
from hnerf.capture.ingest import check_world_of_person
from hnerf.capture.manifest import read_manifest
from hnerf.capture.uncalibrated import Uncalibrated, cameras_without_calibration, image_folders_in
from hnerf.errors import InputError

log = logging.getLogger("hnerf.calibration")


def find_missing_cameras(folder: Path, out: Path) -> None:
    """Write `intri.yml`, `extri.yml` and `report.json` of a recording by several cameras into `out`, and `clocks.toml`
    unless the cameras are in step.

    Images of the same number show the same moment; videos may have started at any time. Clocks and lenses that the
    folder states are used. Raises InputError if the recording does not determine the rest or, before any work, if
    `capture.toml` says what ingestion would refuse afterwards.
    """
    check_world_of_person(folder, read_manifest(folder))
    cameras_without_calibration(folder)  # refuses names that are not there
    log.warning("%s: no calibration (extri.yml or another): finding cameras from the person takes minutes", folder)
    clocks = read_clocks(folder)
    if not clocks and not image_folders_in(folder):
        clocks = found_clocks(folder)
    if clocks:
        out.mkdir(parents=True, exist_ok=True)
        write_clocks(out / FILE, clocks)
    calibrate_recording(folder, clocks=clocks).save(out)


def found_clocks(folder: Path) -> dict[str, Clock]:
    """Return the clocks of a folder of videos. If they cannot be found but all videos have the same frames, warn and
    return none: the cameras are taken to be in step. Otherwise raise InputError that says how to state them."""
    point = read_manifest(folder).subject_point
    if point and point.camera:
        raise InputError(
            f"{folder / 'capture.toml'}: subject: a point in an image has no instant before clocks are known; run "
            f"`hnerf synchronise {folder}` first, or, if the cameras are in step, write {FILE}"
        )
    try:
        found = synchronise_recording(folder)[0].clocks
    except UndeterminedClocksError as error:
        if not have_equal_frames(folder):
            raise InputError(f"{error}; or state the clocks in {FILE} (docs/formats.md)") from None
        log.warning("%s; cameras are taken to be in step, since their videos have the same frames", error)
        return {}
    for name, clock in found.items():
        log.info("camera %s: starts %+.3f s, drifts %+.0f ppm", name, clock.offset_s, 1e6 * (clock.rate - 1))
    return found


def have_equal_frames(folder: Path) -> bool:
    """Return whether all videos have the same number of frames at the same rate, as ingestion demands of cameras
    without clocks."""
    layout = Uncalibrated(folder)
    footage = [layout.footage(name) for name in cameras_without_calibration(folder)]
    rates = [one.fps for one in footage if one.fps]
    equal_rates = not rates or max(rates) <= (1 + RATE_TOLERANCE) * min(rates)
    return equal_rates and len({one.frames for one in footage}) == 1

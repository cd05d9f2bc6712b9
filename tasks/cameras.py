"""The stage that finds clocks and cameras of a recording without calibration."""

import json
from pathlib import Path

from tasks.cage import read_source
from tasks.source import Source
from tasks.stage import stage


@stage("cameras", version="3")
def find_cameras(out: Path, source: Source, programs: tuple[str, ...]) -> dict[str, float]:
    """Find the clocks and cameras of a recording from the person it shows. programs: those installed that read the
    sound of videos, on which the result depends."""
    from hnerf.calibration.find_cameras import find_missing_cameras  # importing this takes a second

    read_source(source, find_missing_cameras, source.root, out)
    cameras = json.loads((out / "report.json").read_text())["cameras"].values()
    return {"worst_median_px": max(camera["median_px"] for camera in cameras)}

"""A recording without calibration, whose cameras and clocks the stage `cameras` found from the person."""

import json
from dataclasses import dataclass
from pathlib import Path

from hnerf.capture.clocks import Clock, read_clocks
from hnerf.capture.formats.easymocap import EasyMocap, read_easymocap
from hnerf.capture.lens import Lens


@dataclass(frozen=True)
class FromPerson(EasyMocap):
    """A capture folder that lacks only cameras and clocks, which are in `found`: `intri.yml`, `extri.yml`,
    `report.json`, and `clocks.toml` unless the cameras are in step. They are in metres, with Z up."""

    found: Path

    def lenses(self) -> dict[str, Lens]:
        """Return every camera that was found."""
        return read_easymocap(self.found)

    def clocks(self) -> dict[str, Clock]:
        """Return the clocks that were found; empty if there are none."""
        return read_clocks(self.found)

    def notes(self) -> list[str]:
        """Return how certain scale and vertical axis are, and when the cameras started."""
        report = json.loads((self.found / "report.json").read_text())
        starts = ", ".join(f"{name} {clock.offset_s:+.3f} s" for name, clock in self.clocks().items())
        clocks = f"images are matched by these clocks: {starts}" if starts else "cameras are taken to be in step"
        return [f"no calibration, so cameras were found from the person; {'; '.join(report['notes'])}", clocks]

"""Camera files for other tools."""

from collections.abc import Callable, Sequence
from pathlib import Path

from hnerf.capture.formats.caliscope import write_aniposelib, write_caliscope
from hnerf.capture.formats.colmap import write_colmap
from hnerf.capture.formats.easymocap import write_easymocap
from hnerf.capture.lens import Lens

WRITERS: dict[str, Callable[[Path, Sequence[Lens]], None]] = {
    "easymocap": write_easymocap,
    "caliscope": write_caliscope,
    "aniposelib": write_aniposelib,
    "colmap": write_colmap,
}


def write_cameras(out: Path, lenses: Sequence[Lens], layout: str) -> None:
    """Write cameras (metres) in a layout of WRITERS into the folder `out`, which is made if need be."""
    out.mkdir(parents=True, exist_ok=True)
    WRITERS[layout](out, lenses)

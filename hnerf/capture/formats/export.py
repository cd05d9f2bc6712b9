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
    """Write cameras (metres) in a layout of WRITERS into the folder `out`, which is created if needed."""
    out.mkdir(parents=True, exist_ok=True)
    WRITERS[layout](out, lenses)


def write_calibration(out: Path, lenses: Sequence[Lens], source: str, layouts: Sequence[str], pose2sim: bool) -> None:
    """Write new cameras where a capture's folder holds them: in `intri.yml` and `extri.yml` or, with a fisheye among
    them, in `calibration.toml`; for the Pose2Sim layout, in `calibration/Calib_<source>.toml`; and in further layouts
    of WRITERS."""
    if pose2sim:
        write_cameras(out / "calibration", lenses, "aniposelib")
        (out / "calibration" / "calibration.toml").rename(out / "calibration" / f"Calib_{source}.toml")
    own = "aniposelib" if any(lens.fisheye for lens in lenses) else "easymocap"
    for layout in {*layouts} if pose2sim else {own, *layouts}:
        write_cameras(out, lenses, layout)

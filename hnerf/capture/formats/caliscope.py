"""Calibrations in TOML: Caliscope's `camera_array.toml` and aniposelib's `calibration.toml`, world to camera.

Images and everything else are laid out as in the EasyMocap layout. Caliscope names the footage of its camera 0 `cam_0`.
"""

import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hnerf.capture.formats.easymocap import EasyMocap
from hnerf.capture.formats.pose2sim import camera_tables, lenses_from_tables
from hnerf.capture.lens import Lens, known_size
from hnerf.capture.safe_io import path_in_capture, read_toml, shown
from hnerf.errors import InputError

FILES = ("camera_array.toml", "calibration.toml")

log = logging.getLogger("hnerf.capture")


class Caliscope(EasyMocap):
    """A capture folder with camera_array.toml, in metres, or with calibration.toml, in the board's unit."""

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        """Return whether the folder looks like this layout."""
        return any((folder / name).exists() for name in FILES)

    def lenses(self) -> dict[str, Lens]:
        """Return every camera that the file calibrates, poses and does not ignore."""
        caliscope = path_in_capture(self.folder, "camera_array.toml")
        path = caliscope if caliscope.exists() else path_in_capture(self.folder, "calibration.toml")
        return lenses_from_tables(path, _caliscope_tables(path) if path == caliscope else camera_tables(path))


def write_caliscope(out: Path, lenses: Sequence[Lens]) -> None:
    """Write `camera_array.toml`. Cameras are numbered in their order, unless all are called cam_<number> already
    (without leading zeros, which TOML numbers do not have); the log says which is which. Raises InputError on a lens
    without size."""
    numbers = [lens.name.removeprefix("cam_") for lens in lenses]
    if not all(re.fullmatch("cam_(0|[1-9][0-9]*)", lens.name) for lens in lenses):
        numbers = [str(i) for i in range(len(lenses))]
        renamed = (f"{lens.name} is cam_{n}" for n, lens in zip(numbers, lenses, strict=True))
        log.warning("Caliscope numbers cameras: %s", ", ".join(renamed))
    tables = (
        f"[cameras.{n}]\ncam_id = {n}\nrotation_count = 0\nignore = false\n"
        f"{_numbers(lens)}rotation = {lens.R.tolist()}\n"
        for n, lens in zip(numbers, lenses, strict=True)
    )
    (out / "camera_array.toml").write_text("\n".join(tables), encoding="utf-8")


def write_aniposelib(out: Path, lenses: Sequence[Lens]) -> None:
    """Write `calibration.toml`, in metres; Pose2Sim reads it as `Calib.toml`, too. Raises InputError on a lens without
    size."""
    tables = (
        f'[cam_{i}]\nname = "{lens.name}"\n{_numbers(lens)}rotation = {cv2.Rodrigues(lens.R)[0].ravel().tolist()}\n'
        for i, lens in enumerate(lenses)
    )
    (out / "calibration.toml").write_text("\n".join([*tables, "[metadata]\nadjusted = false\n"]), encoding="utf-8")


def _numbers(lens: Lens) -> str:
    """Return the lines of a camera that both formats share."""
    shortest = 4 if lens.fisheye else 5
    distortions = np.pad(lens.distortion, (0, max(0, shortest - len(lens.distortion)))).tolist()
    matrix = f"matrix = {lens.K.tolist()}\ndistortions = {distortions}\nfisheye = {str(lens.fisheye).lower()}\n"
    estimated = "estimated = true\n" if lens.estimated else ""
    return f"size = {list(known_size(lens))}\n{matrix}translation = {lens.t_m.tolist()}\n{estimated}"


def _caliscope_tables(path: Path) -> dict[str, dict[str, Any]]:
    """Return the tables of cameras that are not ignored, with their names. Warn about those that Caliscope did not
    pose, and leave them out."""
    cameras = read_toml(path).get("cameras")
    if not isinstance(cameras, dict) or not all(isinstance(table, dict) for table in cameras.values()):
        raise InputError(f"{path}: no tables [cameras.<number>]; calibrate again with Caliscope")
    named = {
        key: table | {"name": f"cam_{table.get('cam_id', table.get('port', key))}"}
        for key, table in cameras.items()
        if not table.get("ignore", False)
    }
    unposed = [key for key, table in named.items() if "rotation" not in table and "translation" not in table]
    if unposed:
        cameras_left_out = ", ".join(shown(named.pop(key)["name"]) for key in unposed)
        log.warning("%s: left out, since they have no rotation and translation: %s", path, cameras_left_out)
    return named

"""The Pose2Sim layout: calibration/Calib*.toml, videos/<camera>.mp4, pose/<camera>_json/*.json."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from hnerf.capture.formats.easymocap import EasyMocap
from hnerf.capture.lens import Lens, by_name, checked_lens
from hnerf.capture.safe_io import files_in, read_toml
from hnerf.errors import InputError


@dataclass(frozen=True)
class Pose2Sim(EasyMocap):
    """A capture folder as Pose2Sim's own tools read it: world to camera, metres, Z up; other files as in the EasyMocap
    layout."""

    mark = "calibration/Calib*.toml"
    novel_pose_share: ClassVar[float] = 0.2  # the last fifth, whose motion the training frames do not contain

    def lenses(self) -> dict[str, Lens]:
        """Return every camera of the one calibration file."""
        files = [p for p in files_in(self.folder, "calibration") if p.match("Calib*.toml")]
        if len(files) != 1:
            raise InputError(f"{self.folder / 'calibration'}: {len(files)} files Calib*.toml; leave exactly one")
        return lenses_from_tables(files[0], camera_tables(files[0]))

    def _images(self, camera: str) -> dict[int, Path]:
        return {} if (self.folder / "videos").is_dir() else super()._images(camera)


def camera_tables(path: Path) -> dict[str, dict[str, Any]]:
    """Return the tables of cameras, those with a matrix or a rotation, in a file of Pose2Sim or aniposelib; Caliscope
    adds others."""
    tables = {key: table for key, table in read_toml(path).items() if isinstance(table, dict)}
    return {key: table for key, table in tables.items() if table.keys() & {"matrix", "rotation"}}


def lenses_from_tables(source: Path, tables: dict[str, dict[str, Any]]) -> dict[str, Lens]:
    """Return the lenses in a file's tables of cameras, by name. Raises InputError if there are none, or as
    `lens_from_table` does."""
    lenses = [lens_from_table(source, key, table) for key, table in tables.items()]
    if not lenses:
        raise InputError(f"{source}: calibrates no camera; calibrate again")
    return by_name(lenses, source)


def lens_from_table(source: Path, key: str, table: dict[str, Any]) -> Lens:
    """Return the lens in one camera's table, from the keys that aniposelib, Pose2Sim and Caliscope share. It is called
    `key` unless the table has a name. Raises InputError if a key is missing or wrong."""
    try:
        if (fisheye := table.get("fisheye", False)) not in (True, False):
            raise ValueError(fisheye)
        width_px, height_px = table["size"]
        return checked_lens(
            source=source,
            name=table.get("name", key),
            K=np.array(table["matrix"], dtype=np.float64),
            distortion=np.array(table["distortions"], dtype=np.float64),
            R=np.array(table["rotation"], dtype=np.float64),
            t_m=np.array(table["translation"], dtype=np.float64),
            size_px=(float(width_px), float(height_px)),
            estimated=table.get("estimated") is True,
            fisheye=bool(fisheye),
        )
    except KeyError as error:
        raise InputError(f"{source}: camera {key[:80]}: {error} is missing; calibrate again") from None
    except (OverflowError, TypeError, ValueError):
        raise InputError(
            f"{source}: camera {key[:80]}: its table, or a value in it, has the wrong type or shape; calibrate again"
        ) from None

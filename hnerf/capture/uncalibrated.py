"""Recordings without a calibration: where their images and keypoints lie, and what is known of their lenses."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hnerf.capture.clocks import Clock
from hnerf.capture.footage import Footage, Video
from hnerf.capture.formats.easymocap import EasyMocap, read_intrinsics
from hnerf.capture.formats.layout import Layout, StoredFrame
from hnerf.capture.formats.pose2sim import lens_from_table
from hnerf.capture.lens import Lens, by_name
from hnerf.capture.manifest import chosen_cameras, read_manifest
from hnerf.capture.safe_io import (
    VIDEO_SUFFIXES,
    by_camera,
    check_camera_name,
    files_in,
    path_in_capture,
    read_toml,
)
from hnerf.capture.video_metadata import focal_35mm
from hnerf.errors import InputError

USUAL_FOCAL = 0.85  # of an image's longer side, 61 degrees across it: a phone's main camera when filming
DIAGONAL_35MM = 43.27  # of a frame of 36 x 24 mm, to which equivalent focal lengths refer


class KnownLens(NamedTuple):
    """A lens before calibration. source: where its focal length comes from, in words, empty if it is a guess."""

    lens: Lens
    source: str


def cameras_without_calibration(folder: Path) -> list[str]:
    """Return the cameras of a folder without camera poses: one for each folder in images/, else for each video in
    videos/, else for each video in the folder itself; of these, the ones that `capture.toml` names, if it names any.
    Possibly none. Raises InputError if it names others."""
    if folders := image_folders_in(folder):
        names = [check_camera_name(path.name, path) for path in folders]
    else:
        names = list(by_camera(videos_in(folder)))
    if not names:
        return []
    split = chosen_cameras(folder, read_manifest(folder), names, [], "the folder")
    return [name for name in names if name in split.train + split.test]


def image_folders_in(folder: Path) -> list[Path]:
    """Return the folders in images/, without hidden ones."""
    images = path_in_capture(folder, "images")
    inside = sorted(images.iterdir()) if images.is_dir() else []
    return [path for path in inside if path.is_dir() and not path.name.startswith(".")]


def videos_in(folder: Path) -> list[Path]:
    """Return the videos in videos/, else those in the folder."""
    return files_in(folder, "videos", suffixes=VIDEO_SUFFIXES) or files_in(folder, suffixes=VIDEO_SUFFIXES)


@dataclass(frozen=True)
class Uncalibrated(Layout):
    """A recording whose camera poses are unknown: all cameras are at the origin.

    lens_file: intrinsics, in `intri.yml` or in a TOML of cameras; fov_deg: field of view of all other cameras, across
    the longer side; only: the one camera to read, else all; found_clocks: used instead of those in the folder;
    calibrated: the layout in which the folder is read with its calibration, if that is known, else EasyMocap's.
    """

    lens_file: Path | None = None
    fov_deg: float | None = None
    only: str | None = None
    found_clocks: Mapping[str, Clock] | None = None
    calibrated: Layout | None = None
    # Opened so far: opening a video decodes all of it.
    _opened: dict[str, Footage] = field(default_factory=dict, init=False, repr=False, compare=False)

    @cached_property
    def known_lenses(self) -> dict[str, KnownLens]:
        """Return each camera's lens from the first source that has it: the lens file, or without one `intri.yml` except
        what an earlier calibration estimated; the field of view; the metadata of images or videos; a guess. Raises
        InputError if a file cannot be read."""
        names = [name for name in cameras_without_calibration(self.folder) if self.only in (None, name)]
        own = path_in_capture(self.folder, "intri.yml")
        contradicted = self.calibrated is not None and type(self.calibrated) is not EasyMocap  # by that calibration
        file = self.lens_file or (own if own.exists() and not contradicted else None)
        read = read_lenses(file) if file else {}
        given = {name: lens for name, lens in read.items() if self.lens_file or not lens.estimated}
        if self.lens_file and not set(given).intersection(names):
            raise InputError(f"{file}: has none of the cameras {', '.join(names)}; name them as the recordings are")
        known = {name: KnownLens(lens, f"from {file.name}") for name, lens in given.items() if file and name in names}
        others = [name for name in names if name not in known]
        if self.fov_deg and not others:
            raise InputError(f"{file}: has the lenses of all cameras; remove --fov or field_of_view_deg, or this file")
        return known | {name: lens_by_angle(name, self.footage(name), self.fov_deg) for name in others}

    def lenses(self) -> dict[str, Lens]:
        """Return the lens of every camera, at the origin."""
        return {name: known.lens for name, known in self.known_lenses.items()}

    def clocks(self) -> dict[str, Clock]:
        """Return the clocks found, else those in the folder; empty if there are none."""
        return super().clocks() if self.found_clocks is None else dict(self.found_clocks)

    def footage(self, camera: str) -> Footage:
        """Return images/<camera>/, else videos/<camera>.mp4, else <camera>.mp4; in Pose2Sim's layout, videos first."""
        if camera not in self._opened:
            self._opened[camera] = self._files.footage(camera)
        return self._opened[camera]

    @property
    def _files(self) -> Layout:
        return self.calibrated or EasyMocap(self.folder)

    def keypoint_files(self, camera: str) -> dict[int, StoredFrame]:
        """Return openpose/<camera>/, else pose/<camera>_json/."""
        return self._files.keypoint_files(camera)

    def mask_files(self, camera: str) -> dict[int, StoredFrame]:
        """Return masks/<camera>/ or mask/, which give outlines; none if one camera is read alone, for its clock."""
        return {} if self.only else self._files.mask_files(camera)

    def plate_file(self, camera: str) -> Path | None:
        """Return background/<camera>.jpg or .png, with which outlines are found; none if one camera is read alone."""
        return None if self.only else self._files.plate_file(camera)


def lens_by_angle(name: str, footage: Footage, fov_deg: float | None) -> KnownLens:
    """Return a lens without distortion, at the origin, whose field of view across the longer side is the given one,
    else that in the metadata of the first image or the video, else the usual one."""
    first = next(footage.read(footage.frames[:1]))
    width_px, height_px = first.size_px
    aspect = footage.pixel_aspect if isinstance(footage, Video) else 1.0
    sides = np.array([aspect * width_px, height_px])  # in heights of a pixel, as is the focal length
    equivalent_mm = focal_35mm(first.file or footage.path)
    focal, source = USUAL_FOCAL * sides.max(), ""
    if fov_deg:
        focal, source = sides.max() / 2 / np.tan(np.deg2rad(fov_deg) / 2), f"{fov_deg:g} degrees given"
    elif equivalent_mm:
        focal = equivalent_mm / DIAGONAL_35MM * np.linalg.norm(sides)
        source = f"{equivalent_mm:g} mm, metadata"
    K = np.array([[focal / aspect, 0, (width_px - 1) / 2], [0, focal, (height_px - 1) / 2], [0, 0, 1]])
    lens = Lens(name, K, np.zeros(4), np.eye(3), np.zeros(3), (width_px, height_px), estimated=True)
    return KnownLens(lens, source)


def read_lenses(path: Path) -> dict[str, Lens]:
    """Return the lenses of a file of intrinsics; poses in it, if any, are not read."""
    if path.suffix.lower() in (".yml", ".yaml"):
        return read_intrinsics(path)
    tree = read_toml(path)
    tables = tree.get("cameras", tree)
    nowhere = {"rotation": [0, 0, 0], "translation": [0, 0, 0]}
    lenses = [
        lens_from_table(path, key, {"name": f"cam_{table.get('cam_id', table.get('port', key))}"} | table | nowhere)
        for key, table in (tables.items() if isinstance(tables, dict) else ())
        if isinstance(table, dict) and "matrix" in table and not table.get("ignore", False)
    ]
    if not lenses:
        raise InputError(f"{path}: no tables of cameras with a matrix; give intri.yml or a TOML as in docs/formats.md")
    return by_name(lenses, path)

"""Just videos, without calibration: in videos/, directly in the folder, or one file."""

import dataclasses
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hnerf.capture.footage import Footage, Video
from hnerf.capture.formats.easymocap import EasyMocap, read_intrinsics
from hnerf.capture.lens import Lens
from hnerf.capture.manifest import read_manifest
from hnerf.capture.safe_io import VIDEO_SUFFIXES, check_camera_name, path_in_capture
from hnerf.capture.uncalibrated import USUAL_FOCAL, lens_by_angle, videos_in
from hnerf.errors import InputError
from hnerf.geometry.axes import CAMERA_FROM_Z_UP

CAMERA = "camera"

log = logging.getLogger("hnerf.capture")


@dataclass(frozen=True)
class Videos(EasyMocap):
    """Videos of a person, with keypoints, masks and clean plates as in the EasyMocap layout. A single video, or the
    only one that `capture.toml` names, needs no calibration: its camera is taken to be level, with the lens of
    `intri.yml`, or the field of view that `capture.toml` states. Several need their relative poses."""

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        """Return whether there is a video: the file itself, in the folder, or in its videos/."""
        return bool(_videos(folder))

    def lenses(self) -> dict[str, Lens]:
        """Return the one camera: at the origin, with its lens in `intri.yml`, else the longer side's field of view, and
        Z up."""
        video, file = self._video, self.folder / "intri.yml"
        name = _camera_name(video)
        if self.folder.is_dir() and path_in_capture(self.folder, file.name).exists():
            given = read_intrinsics(file)
            if name not in given:
                raise InputError(f"{file}: has no camera {name}; give video and camera one name")
            return {name: dataclasses.replace(given[name], R=CAMERA_FROM_Z_UP)}
        stated = read_manifest(self.folder).field_of_view_deg
        known = lens_by_angle(name, Video(video, (0,), None), stated)
        if not known.source:
            log.warning(
                "%s: no calibration: assuming a level camera that sees %.0f degrees across its longer side; if that is "
                "wrong, limbs are too deep or too flat: state field_of_view_deg in capture.toml%s",
                self.folder,
                np.rad2deg(2 * np.arctan(0.5 / USUAL_FOCAL)),
                "" if self.folder.is_dir() else ", in a folder with the video, and run that folder",
            )
        return {name: dataclasses.replace(known.lens, R=CAMERA_FROM_Z_UP)}

    def footage(self, camera: str) -> Footage:
        """Return the one video."""
        return Video.open(self._video)

    @property
    def _video(self) -> Path:
        """Return the one video, or the one of several that `capture.toml` names. Raises InputError if it names no or
        several cameras."""
        videos = _videos(self.folder)
        if len(videos) > 1 and (split := read_manifest(self.folder).cameras):
            videos = [video for video in videos if _camera_name(video) in split.train + split.test] or videos
        if len(videos) > 1:
            raise InputError(
                f"{self.folder}: {len(videos)} videos without calibration; find their cameras with `hnerf "
                f"calibrate {self.folder}` from footage of a board, or with --from person"
            )
        return videos[0]


def _camera_name(video: Path) -> str:
    """Return the name of a video's file if a camera can have it, which those from phones and messengers may not; else
    CAMERA."""
    try:
        return check_camera_name(video.stem, video)
    except InputError:
        return CAMERA


def _videos(folder: Path) -> list[Path]:
    """Return the file itself if it is a video, else those of the folder."""
    return [folder] if folder.is_file() and folder.suffix.lower() in VIDEO_SUFFIXES else videos_in(folder)

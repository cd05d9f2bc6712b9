"""Just videos, without calibration: in videos/, beside each other in a folder, or one file."""

import logging
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hnerf.capture.footage import Footage, Video
from hnerf.capture.formats.layout import Layout
from hnerf.capture.formats.peoplesnapshot import CAMERA_FROM_Z_UP
from hnerf.capture.lens import Lens
from hnerf.capture.manifest import read_manifest
from hnerf.capture.safe_io import VIDEO_SUFFIXES, check_camera_name, files_in
from hnerf.errors import InputError

USUAL_FIELD_OF_VIEW_DEG = 60.0  # of the longer side: a phone's main camera, 26 to 30 mm of a 36 mm film, in video mode

log = logging.getLogger("hnerf.capture")


@dataclass(frozen=True)
class Videos(Layout):
    """Videos of a person. One needs no calibration: the camera is held level, with the field of view that
    `capture.toml` states. Several need each other's places."""

    @staticmethod
    def recognises(folder: Path) -> bool:
        """Return whether there is a video: the file itself, in the folder, or in its videos/."""
        return bool(_videos(folder))

    def lenses(self) -> dict[str, Lens]:
        """Return the one camera: at the origin, with the longer side's field of view, and Z up."""
        videos = _videos(self.folder)
        if len(videos) > 1:
            raise InputError(
                f"{self.folder}: {len(videos)} videos without calibration; add intri.yml and extri.yml (`hnerf "
                "calibrate` makes them from footage of a board; docs/formats.md lists other files), or leave one video"
            )
        name = check_camera_name(videos[0].stem, videos[0])
        first = next(Video(videos[0], (0,), None).read((0,)))
        size_px = first.rgb.shape[1], first.rgb.shape[0]
        focal_px = max(size_px) / 2 / math.tan(math.radians(self._field_of_view_deg()) / 2)
        K = np.array([[focal_px, 0, (size_px[0] - 1) / 2], [0, focal_px, (size_px[1] - 1) / 2], [0, 0, 1]])
        return {name: Lens(name, K, np.zeros(5), CAMERA_FROM_Z_UP, np.zeros(3), size_px)}

    def footage(self, camera: str) -> Footage:
        """Return the camera's video."""
        return Video.open(next(path for path in _videos(self.folder) if path.stem == camera))

    def _field_of_view_deg(self) -> float:
        given = read_manifest(self.folder).field_of_view_deg
        if given is None:
            log.warning(
                "%s: no calibration: a camera held level, whose longer side sees %g degrees, is assumed; if that is "
                "wrong, limbs are too deep or too flat: state field_of_view_deg in capture.toml",
                self.folder,
                USUAL_FIELD_OF_VIEW_DEG,
            )
        return given or USUAL_FIELD_OF_VIEW_DEG


def _videos(folder: Path) -> list[Path]:
    """Return the file itself if it is a video, else the videos in videos/, else those in the folder."""
    if folder.is_file():
        return [folder] if folder.suffix.lower() in VIDEO_SUFFIXES else []
    return files_in(folder, "videos", suffixes=VIDEO_SUFFIXES) or files_in(folder, suffixes=VIDEO_SUFFIXES)

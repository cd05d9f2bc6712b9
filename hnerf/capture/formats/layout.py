"""What every layout on disk offers to `ingest`."""

from pathlib import Path
from typing import ClassVar, Protocol

import numpy as np

from hnerf.capture.footage import Footage
from hnerf.capture.guarded import read_json
from hnerf.capture.lens import Lens
from hnerf.errors import CaptureError

MAX_PEOPLE = 64


class Layout(Protocol):
    """One capture folder in one layout. `novel_pose_share`: of the frames, where no `capture.toml` splits them."""

    novel_pose_share: ClassVar[float]

    def lenses(self) -> dict[str, Lens]:
        """Every calibrated camera, translations in the capture's own unit."""
        ...

    def footage(self, camera: str) -> Footage:
        """Its pictures; CaptureError if there are none."""
        ...

    def keypoint_files(self, camera: str) -> dict[int, Path]:
        """OpenPose JSON files by frame; empty where nothing was detected for this camera."""
        ...

    def mask_files(self, camera: str) -> dict[int, Path]:
        """Given person masks by frame; empty where there are none."""
        ...

    def plate_file(self, camera: str) -> Path | None:
        """Clean plate, or None."""
        ...

    def to_body_25(self, keypoints: np.ndarray) -> np.ndarray:
        """(..., 25, 3) keypoints in the file's order to BODY_25."""
        ...


def read_openpose(path: Path) -> np.ndarray:
    """(people, 25, 3) x_px, y_px, confidence in the file's order; CaptureError if it is not such a file."""
    try:
        people = read_json(path)["people"]
        if len(people) > MAX_PEOPLE:
            raise CaptureError(f"{path}: {len(people)} people; keep at most {MAX_PEOPLE}")
        points = np.array([person["pose_keypoints_2d"] for person in people], dtype=np.float64).reshape(-1, 75)
    except (KeyError, TypeError, ValueError):
        raise CaptureError(f"{path}: not OpenPose keypoints of 25 points a person; detect them again") from None
    if not np.isfinite(points).all():
        raise CaptureError(f"{path}: a keypoint is NaN or infinite; detect them again")
    return points.reshape(-1, 25, 3)

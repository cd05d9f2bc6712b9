"""What every layout on disk offers to `ingest`."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from hnerf.capture.footage import Footage
from hnerf.capture.given_poses import GivenPoses
from hnerf.capture.lens import Lens


class Stored(NamedTuple):
    """One frame of a file that holds a whole recording. path: for messages; read: a mask (H, W) uint8, or keypoints
    (people, K, 3) as `read_openpose` returns them."""

    path: Path
    read: Callable[[], np.ndarray]


@dataclass(frozen=True)
class Layout(ABC):
    """One capture folder in one layout; what most layouts do not have is left out here.

    `novel_pose_share`: of the frames, where no `capture.toml` splits them.
    """

    folder: Path
    novel_pose_share: ClassVar[float] = 0.0

    @staticmethod
    @abstractmethod
    def recognises(folder: Path) -> bool:
        """Whether the folder looks like this layout."""

    @abstractmethod
    def lenses(self) -> dict[str, Lens]:
        """Every calibrated camera, translations in the capture's own unit."""

    @abstractmethod
    def footage(self, camera: str) -> Footage:
        """Its pictures; InputError if there are none."""

    def training_cameras(self) -> list[str]:
        """Those that the recording's own publication trains on, the rest being for testing; empty: all of them."""
        return []

    def keypoint_files(self, camera: str) -> dict[int, Path | Stored]:
        """OpenPose JSON files, or the like, by frame; empty where nothing was detected for this camera."""
        return {}

    def mask_files(self, camera: str) -> dict[int, Path | Stored]:
        """Given person masks by frame; empty where there are none."""
        return {}

    def plate_file(self, camera: str) -> Path | None:
        """Clean plate, or None."""
        return None

    def given_poses(self, frames: tuple[int, ...]) -> GivenPoses | None:
        """Somebody's fit of a body model, for these frames; None where there is none."""
        return None

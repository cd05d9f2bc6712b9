"""The interface of a layout on disk, as `ingest` uses it."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from hnerf.capture.clocks import Clock, read_clocks
from hnerf.capture.footage import Footage
from hnerf.capture.given_poses import GivenPoses
from hnerf.capture.lens import Lens


class StoredFrame(NamedTuple):
    """The mask or keypoints of one frame. path: the file that holds them; place: the same file if it holds all frames,
    else its folder, for messages; read: returns a mask (H, W) uint8, or keypoints (people, K, 3) as `read_openpose`
    does."""

    path: Path
    place: Path
    read: Callable[[], np.ndarray]


def one_a_file(files: dict[int, Path], read: Callable[[Path], np.ndarray]) -> dict[int, StoredFrame]:
    """Return the frames of files that hold one each; `read` reads a file."""
    return {frame: StoredFrame(path, path.parent, partial(read, path)) for frame, path in files.items()}


@dataclass(frozen=True)
class Layout(ABC):
    """A capture folder in one layout. Methods for data that most layouts lack return nothing by default.

    `mark`: a file, or a folder with a trailing slash, that only this layout has; its name may have wildcards.
    `novel_pose_share`: share of the frames for novel poses if no `capture.toml` splits them.
    """

    folder: Path
    mark: ClassVar[str] = ""
    novel_pose_share: ClassVar[float] = 0.0

    @classmethod
    def recognises(cls, folder: Path) -> bool:
        """Return whether the folder looks like this layout."""
        return any(folder.glob(cls.mark))

    @abstractmethod
    def lenses(self) -> dict[str, Lens]:
        """Return every calibrated camera, translations in the capture's own unit."""

    @abstractmethod
    def footage(self, camera: str) -> Footage:
        """Return a camera's images. Raises InputError if there are none."""

    def clocks(self) -> dict[str, Clock]:
        """Return the cameras' clocks; empty if they are in step. Raises InputError on a bad value."""
        return read_clocks(self.folder)

    def notes(self) -> list[str]:
        """Return what the report says about the cameras; empty for a calibration of the recording's own."""
        return []

    def training_cameras(self) -> list[str]:
        """Return the cameras that the recording's own publication trains on, the rest being for testing; an empty list
        means all."""
        return []

    def keypoint_files(self, camera: str) -> dict[int, StoredFrame]:
        """Return keypoints by frame; empty if nothing was detected for this camera."""
        return {}

    def mask_files(self, camera: str) -> dict[int, StoredFrame]:
        """Return given person masks by frame; empty if there are none."""
        return {}

    def plate_file(self, camera: str) -> Path | None:
        """Return the clean plate, or None."""
        return None

    def given_poses(self, frames: tuple[int, ...]) -> GivenPoses | None:
        """Return the poses of a body model given for these frames; None if there are none."""
        return None

"""The images of a capture that evaluation renders, by split, and the paths of their renderings."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from hnerf.capture.capture import Capture
from hnerf.evenly_spaced import evenly_spaced
from hnerf.results.scores import Primary, Split

NOVEL_VIEW: Literal["novel_view"] = "novel_view"
ANIMATED: Literal["novel_pose"] = "novel_pose"  # the columns of hnerf/evaluation/columns.py
POSED: Literal["novel_pose_posed"] = "novel_pose_posed"
TRACKED: Literal["novel_pose_tracked"] = "novel_pose_tracked"
NOVEL_POSE_SPLITS: tuple[Split, ...] = (ANIMATED, POSED, TRACKED)
SPLITS: tuple[Split, ...] = (NOVEL_VIEW, *NOVEL_POSE_SPLITS)
PRIMARY_SPLITS: tuple[Primary, ...] = (NOVEL_VIEW, ANIMATED)
TRAINING_VIEW = "training_view"  # shown in the report, never scored


@dataclass(frozen=True)
class View:
    """One image of a split."""

    split: str
    camera: str
    frame: int

    def path(self, out: Path) -> Path:
        """Return the path of the view's rendering in the evaluation folder."""
        return out / "renders" / self.split / self.camera / f"{self.frame:06d}.png"


def split_frames(capture: Capture, split: str) -> tuple[int, ...]:
    """Return the frames whose poses a split shows: novel-pose frames, or the training frames for novel_view and
    training views."""
    return capture.novel_pose_frames if split in NOVEL_POSE_SPLITS else capture.train_frames


def all_views(capture: Capture, split: str) -> list[View]:
    """Return every image of a split, from the test cameras. A capture without any shows novel poses from its training
    cameras, for inspection only."""
    seen_in_training = split == TRAINING_VIEW or (split in NOVEL_POSE_SPLITS and not capture.test_cameras)
    cameras = capture.train_cameras if seen_in_training else capture.test_cameras
    return [View(split, camera, frame) for camera in cameras for frame in split_frames(capture, split)]


def sample_views(views: list[View], count: int) -> list[View]:
    """Return at most `count` of a split's images: frames evenly spaced over the recording, the cameras in turn; if
    there are fewer frames, evenly spaced over all images."""
    frames = sorted({view.frame for view in views})
    if len(frames) < count:
        return evenly_spaced(views, count)
    seen = {frame: [view for view in views if view.frame == frame] for frame in evenly_spaced(frames, count)}
    return [own[k % len(own)] for k, own in enumerate(seen.values())]

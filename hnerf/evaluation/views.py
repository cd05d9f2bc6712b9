"""Which images of a capture are rendered, under which split, and where they lie."""

from dataclasses import dataclass
from pathlib import Path

from hnerf.capture.capture import Capture
from hnerf.evenly_spaced import evenly_spaced

NOVEL_VIEW = "novel_view"
ANIMATED, POSED, TRACKED = "novel_pose", "novel_pose_posed", "novel_pose_tracked"  # hnerf/evaluation/columns.py
NEW_POSES = (ANIMATED, POSED, TRACKED)
SPLITS = (NOVEL_VIEW, *NEW_POSES)
PRIMARY = (NOVEL_VIEW, ANIMATED)  # meshed, and what a camera that was left out is scored on
TRAINING_VIEW = "training_view"  # shown in the report, never scored


@dataclass(frozen=True)
class View:
    """One image of a split."""

    split: str
    camera: str
    frame: int

    def path(self, out: Path) -> Path:
        """Its rendering below the evaluation folder."""
        return out / "renders" / self.split / self.camera / f"{self.frame:06d}.png"


def split_frames(capture: Capture, split: str) -> tuple[int, ...]:
    """The frames whose poses a split is about; novel_view and the training views are about the training frames."""
    return capture.novel_pose_frames if split in NEW_POSES else capture.train_frames


def split_cameras(capture: Capture, split: str) -> tuple[str, ...]:
    """The cameras a split is seen from: test cameras; where there are none, new poses from the training cameras, for
    people to look at."""
    if split == TRAINING_VIEW or (split in NEW_POSES and not capture.test_cameras):
        return capture.train_cameras
    return capture.test_cameras


def all_views(capture: Capture, split: str) -> list[View]:
    """Every image of a split."""
    return [View(split, c, f) for c in split_cameras(capture, split) for f in split_frames(capture, split)]


def some_views(views: list[View], count: int) -> list[View]:
    """At most `count` of a split's images: frames spread over the recording, the cameras in turn; where there are fewer
    frames than that, spread over all images."""
    frames = sorted({view.frame for view in views})
    if len(frames) < count:
        return evenly_spaced(views, count)
    seen = {frame: [view for view in views if view.frame == frame] for frame in evenly_spaced(frames, count)}
    return [own[k % len(own)] for k, own in enumerate(seen.values())]

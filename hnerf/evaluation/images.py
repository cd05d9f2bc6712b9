"""The images of a split: which there are, their renderings and their scores."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from hnerf.avatar.avatar import Avatar, Rendering
from hnerf.capture.capture import Capture, read_rgba, write_image
from hnerf.errors import InputError
from hnerf.evaluation import metrics
from hnerf.evaluation.ground_truth import Truth
from hnerf.evaluation.views import NOVEL_POSE_SPLITS, View, all_views, sample_views
from hnerf.progress import tracked
from hnerf.results.scores import ImageScores, Mean, SplitScores
from hnerf.side_by_side import side_by_side

MEANS: tuple[Mean, ...] = get_args(Mean)  # averaged over a split's images
TUNED_ON = (
    "the capture has no test camera, and training cameras saw these frames when their poses were fitted; "
    "evaluation.holdout scores a field that was trained without one of them"
)


def scored_views(split: str, truth: Truth, count: int | None) -> list[View]:
    """Return all images of a split, or at most `count` of those with a true mask (of all, if none has one)."""
    views = all_views(truth.capture, split)
    if count is None:
        return views
    return sample_views(views_with_mask(views, truth) or views, count)


def views_with_mask(views: list[View], truth: Truth) -> list[View]:
    """Return the views that have a true mask."""
    return [view for view in views if truth.has_mask(view.camera, view.frame)]


def render(avatars: Mapping[str, Avatar], capture: Capture, views: list[View], out: Path) -> float:
    """Render every view with its split's avatar, in the poses of its `body`, and write it as 8-bit RGBA, colour over
    black and coverage. Return the wall-clock seconds per image; on a CPU, several are rendered at a time."""

    def write(view: View) -> None:
        avatar = avatars[view.split]
        with torch.no_grad():
            pixels = rgba(avatar.render(capture.cameras[view.camera], *avatar.body.pose(view.frame)))
        write_image(view.path(out), pixels)

    started = time.perf_counter()
    device = next(iter(avatars.values())).body.theta.device
    for _ in tracked(side_by_side(write, views, device), "rendering", len(views)):
        pass
    return (time.perf_counter() - started) / max(1, len(views))


def rgba(rendering: Rendering) -> np.ndarray:
    """Convert a rendering to (H, W, 4) uint8: colour over black, and coverage. Raises InputError if a value is NaN,
    which would become black."""
    both = torch.cat([rendering.rgb, rendering.alpha[..., None]], -1)
    if both.isnan().any():
        raise InputError("the trained field renders NaN; train it with another training.seed")
    return (both.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def score_split(split: str, views: list[View], truth: Truth, out: Path) -> SplitScores:
    """Return the mean image scores of a split's renderings, and those of each image; null with a reason if there are
    none."""
    if not views:
        missing = "novel-pose frames" if split in NOVEL_POSE_SPLITS else "test cameras"
        return unscored(f"the capture has no {missing}")
    if not truth.capture.test_cameras:
        return unscored(TUNED_ON)
    if not truth.has_masks:
        return unscored("the test cameras have neither ground-truth masks nor masks that came with the recording")
    rows: list[ImageScores] = []
    references = set()
    known = views_with_mask(views, truth)
    for view in known:
        mask = truth.mask(view.camera, view.frame)
        if not mask.any():
            continue
        reference, source = truth.on_black(view.camera, view.frame)
        score = metrics.score_image(read_rgba(view.path(out)), reference, mask)
        references.add(source)
        row: Any = {"camera": view.camera, "frame": view.frame} | score
        rows.append(row | metrics.trivial_psnr(reference, mask))
    if not rows:
        return unscored(
            "no image of this split shows the person" if known else "no image of this split has a mask to score it by"
        )
    means: Any = {"n": len(rows)} | {name: mean_of([row[name] for row in rows]) for name in MEANS}
    without = {"without_mask": len(views) - len(known), "without_person": len(known) - len(rows)}
    return means | without | {"reference": " and ".join(sorted(references)), "per_image": rows}


def mean_of(values: Sequence[float | None]) -> float | None:
    """Return the mean of the values that are not None; None if there are none."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def unscored(reason: str) -> SplitScores:
    """Return the scores of a split that has none, and the reason."""
    nothing: Any = {"n": 0, "per_image": []}
    return nothing | dict.fromkeys(MEANS) | {"reason": reason}

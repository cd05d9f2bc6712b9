"""The subject's keypoints in the form that a fit needs."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from hnerf.body.reprojection import Views
from hnerf.capture.capture import Capture
from hnerf.capture.subject import ranked_people
from hnerf.capture.timing import median_step
from hnerf.geometry.triangulation import triangulate

MAX_GAP = 2  # median steps between neighbours in one run: where frames are unevenly spaced, or one is missing


@dataclass(frozen=True)
class Observations(Views):
    """Observed keypoints: pixels (C, n, 25, 2) and confidence (C, n, 25) of the training cameras, float64; space_m (n,
    25, 3), triangulated, NaN where fewer than two cameras agree."""

    space_m: Tensor

    def keypoints(self, camera: int) -> np.ndarray:
        """Return what one camera sees, (n, 25, 3): x_px, y_px, confidence."""
        return torch.cat([self.pixels[camera], self.confidence[camera, ..., None]], -1).numpy()


def observe(capture: Capture) -> Observations:
    """Return the keypoints of every frame, from training cameras only. Raises InputError if the capture has none."""
    keypoints = ranked_people(capture)[0].keypoints
    cameras = tuple(capture.cameras[name] for name in capture.train_cameras)
    space_m, _, _ = triangulate(cameras, keypoints)
    pixels, confidence = torch.from_numpy(keypoints).split([2, 1], -1)
    return Observations(cameras, pixels, confidence[..., 0], torch.from_numpy(space_m))


def runs(capture: Capture) -> list[tuple[int, ...]]:
    """Return the frames, divided into runs without gaps in time. A step in frame numbers of more than MAX_GAP median
    steps starts a new run. So does a change of split, if it is the only one: all novel poses may come from another
    recording, appended to the first. Splits that alternate divide a single recording."""
    novel, farthest = set(capture.novel_pose_frames), MAX_GAP * median_step(capture.frames)
    changes = {b for a, b in pairwise(capture.frames) if (a in novel) != (b in novel)}
    found: list[list[int]] = []
    for frame in capture.frames:
        if found and frame <= found[-1][-1] + farthest and changes != {frame}:
            found[-1].append(frame)
        else:
            found.append([frame])
    return [tuple(run) for run in found]

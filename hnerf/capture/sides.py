"""Left and right as cameras see them: in single images, mostly from behind, detectors exchange a person's arms or
legs."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from hnerf.capture.body_25 import Body25
from hnerf.capture.people import person_heights_px
from hnerf.geometry.camera import Camera
from hnerf.geometry.triangulation import confidence_of, reprojection_px, solve_points

# Keypoints that are exchanged together: each right one with the left one after it. Eyes and ears are too close to each
# other to tell.
PARTS = tuple(
    tuple((Body25[f"R_{name}"], Body25[f"L_{name}"]) for name in names)
    for names in (
        ("SHOULDER", "ELBOW", "WRIST"),
        ("HIP", "KNEE", "ANKLE", "BIG_TOE", "SMALL_TOE", "HEEL"),
    )
)
GROSS_SHARE = 0.1  # of a person's height: larger errors count as this, since a point may be wrong in other ways
GAIN_SHARE = 0.04  # of a person's height, in the sum over cameras: what an exchange must gain; noise gains less
AGREED_SHARE = 0.03  # of a person's height, in the mean: farther apart, cameras disagree about more than sides
NEAR_S = 0.3  # between frames of which one tells the sides of the other


def put_sides_right(
    cameras: Sequence[Camera], keypoints: Float[np.ndarray, "C F 25 3"], times_s: Float[np.ndarray, " F"]
) -> tuple[Float[np.ndarray, "C F 25 3"], Bool[np.ndarray, "C F"]]:
    """Return a person's keypoints with left and right as most cameras see them, and which images had any exchanged.

    In each frame, the camera is exchanged, or exchanged back, whose view then comes closest to the triangulated points;
    then another one, and so on. Of these steps the one counts that agrees best, if each exchange gains GAIN_SHARE in
    the mean. If half of the cameras are exchanged, either half may be right: the frame before or after tells, within
    NEAR_S, in which nobody turns by a right angle. If there is none, nothing is exchanged.
    """
    found, anywhere = keypoints.copy(), np.zeros(keypoints.shape[:2], bool)
    heights_px = person_heights_px(keypoints)[..., None].clip(1)
    projections = np.stack([camera.projection for camera in cameras])
    for part in PARTS:
        points = np.array(part).ravel()
        sides = np.stack([keypoints[:, :, points], keypoints[:, :, np.array(part)[:, ::-1].ravel()]])
        which = _exchanges(projections, sides, heights_px, times_s)
        found[:, :, points] = np.where(which[..., None, None], sides[1], sides[0])
        anywhere |= which
    return found, anywhere


def _exchanges(projections: np.ndarray, sides: np.ndarray, heights_px: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Return in which images, (C, F) bool, to exchange a part. sides (2, C, F, K, 3): its keypoints as they are, and
    exchanged."""
    cameras, frames = sides.shape[1], np.arange(sides.shape[2])
    # Points of one side alone would agree with nothing, and thus with everything, once they are exchanged.
    sides = np.concatenate([sides[..., :2], sides[..., 2:] * (sides[..., 2:] > 0).all(0)], -1)
    now, one_more = np.zeros((cameras, len(frames)), bool), np.eye(cameras, dtype=bool)
    steps, changed = [], np.zeros_like(now)
    for _ in range(cameras + 1):
        points_m, errors = _errors(projections, sides, now, heights_px)
        steps.append((now, errors[0].sum(0), points_m[:, ::2] - points_m[:, 1::2]))  # last: from left to right
        changed = one_more[np.where(changed, -np.inf, errors[0] - errors[1]).argmax(0)].T
        now = now ^ changed
        now = np.where(2 * now.sum(0) > cameras, ~now, now)  # which agree as well
    tried, costs, across_m = (np.stack(each) for each in zip(*steps, strict=True))
    least = (costs + GAIN_SHARE * tried.sum(1)).argmin(0)
    which, across_m = tried[least, :, frames].T, across_m[least, frames]
    sure = costs[least, frames] < cameras * AGREED_SHARE
    which = which & sure
    ties = np.nonzero(2 * which.sum(0) == cameras)[0]
    sure[ties] = False
    for step in (-1, 1):  # by the frame before, else by the one after
        for t in ties[::-step]:
            other = t + step
            if sure[t] or not 0 <= other < len(sure) or not sure[other] or abs(times_s[t] - times_s[other]) > NEAR_S:
                continue
            same = np.nansum(across_m[t] * across_m[other])
            if same < 0:
                which[:, t], across_m[t] = ~which[:, t], -across_m[t]
            sure[t] = same != 0
    which[:, ties] &= sure[ties]
    return which


def _errors(
    projections: np.ndarray, sides: np.ndarray, which: np.ndarray, heights_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangulated points (F, K, 3) of a part, exchanged in the images `which` (C, F), and how far each view
    is from them in the mean, as a share of the person's height: as it is, and exchanged once more, (2, C, F)."""
    views = np.where(which[..., None, None], sides[::-1], sides).reshape(2, len(projections), -1, 3)
    points_m = solve_points(projections, views[0], confidence_of(views[0]))
    errors = np.stack([reprojection_px(projections, points_m, view) for view in views]).reshape(sides.shape[:-1])
    errors = errors / heights_px
    counts = (sides[..., 2] > 0) & np.isfinite(errors)
    totals = np.where(counts, np.minimum(errors, GROSS_SHARE), 0.0).sum(-1)
    return points_m.reshape(*sides.shape[2:4], 3), totals / counts.sum(-1).clip(1)

"""Left and right as cameras see them: in single images, mostly from behind, detectors exchange a person's arms, legs or
ears."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from hnerf.capture.body_25 import Body25
from hnerf.capture.people import person_heights_px
from hnerf.geometry.camera import Camera
from hnerf.geometry.triangulation import confidence_of, reprojection_px, solve_points

# Keypoints that detectors exchange together: each right one with the left one after it.
PARTS = tuple(
    tuple((Body25[f"R_{name}"], Body25[f"L_{name}"]) for name in names)
    for names in (
        ("SHOULDER", "ELBOW", "WRIST"),
        ("HIP", "KNEE", "ANKLE", "BIG_TOE", "SMALL_TOE", "HEEL"),
        ("EYE", "EAR"),
    )
)
GROSS_SHARE = 0.1  # of a person's height: larger errors count as this, since a point may be wrong in other ways
GAIN_SHARE = 0.04  # of a person's height, in the sum over cameras: what an exchange must gain; noise gains less


def put_sides_right(
    cameras: Sequence[Camera], keypoints: Float[np.ndarray, "C F 25 3"]
) -> tuple[Float[np.ndarray, "C F 25 3"], Bool[np.ndarray, "C F"]]:
    """Return a person's keypoints with left and right as most cameras see them, and which images had any exchanged.

    In each frame, that camera is exchanged whose exchange brings the views closest to their triangulated points, then
    the next, up to half of the cameras; of these steps the one counts that comes closest, if each exchange gains
    GAIN_SHARE in the mean. Since half of the cameras may be wrong, or most, all are exchanged if right then lies where
    left lay in the frame before. Where all agree, a frame stays as it is.
    """
    found, anywhere = keypoints.copy(), np.zeros(keypoints.shape[:2], bool)
    heights_px = person_heights_px(keypoints)[..., None].clip(1)
    projections = np.stack([camera.projection for camera in cameras])
    for part in PARTS:
        points = np.array(part).ravel()
        sides = np.stack([keypoints[:, :, points], keypoints[:, :, np.array(part)[:, ::-1].ravel()]])
        which = _exchanges(projections, sides, heights_px)
        found[:, :, points] = np.where(which[..., None, None], sides[1], sides[0])
        anywhere |= which
    return found, anywhere


def _exchanges(projections: np.ndarray, sides: np.ndarray, heights_px: np.ndarray) -> np.ndarray:
    """Return in which images, (C, F) bool, to exchange a part. sides (2, C, F, K, 3): its keypoints as they are, and
    exchanged."""
    cameras, frames = sides.shape[1], np.arange(sides.shape[2])
    now, one_more = np.zeros((cameras, len(frames)), bool), np.eye(cameras, dtype=bool)
    tried, costs = [now], [_cost(projections, sides, now, heights_px)[1]]
    for _ in range(cameras // 2):
        trials = np.stack([_cost(projections, sides, now | more[:, None], heights_px)[1] for more in one_more])
        best = np.where(now, np.inf, trials).argmin(0)  # another camera, even if it gains only together with the next
        now = now | one_more[best].T
        tried.append(now)
        costs.append(trials[best, frames])
    least = (np.stack(costs) + GAIN_SHARE * np.arange(len(costs))[:, None]).argmin(0)
    which = np.stack(tried)[least, :, frames].T
    which &= np.stack(costs)[least, frames] < cameras * GROSS_SHARE / 2  # beyond, they disagree about more than sides
    points_m = _cost(projections, sides, which, heights_px)[0]
    across_m = points_m[:, ::2] - points_m[:, 1::2]  # from left to right
    for t in np.nonzero(which.any(0))[0]:
        if t and np.nansum(across_m[t] * across_m[t - 1]) < 0:
            which[:, t], across_m[t] = ~which[:, t], -across_m[t]
    return which


def _cost(
    projections: np.ndarray, sides: np.ndarray, which: np.ndarray, heights_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangulated points (F, K, 3) of a part, exchanged in the images `which` (C, F), and the sum over
    cameras of how far a view is from them in the mean, (F,), as a share of the person's height."""
    views = np.where(which[..., None, None], sides[1], sides[0])
    flat = views.reshape(len(views), -1, 3)
    points_m = solve_points(projections, flat, confidence_of(flat))
    errors = reprojection_px(projections, points_m, flat).reshape(views.shape[:3]) / heights_px
    counts = (views[..., 2] > 0) & np.isfinite(errors)
    totals = np.where(counts, np.minimum(errors, GROSS_SHARE), 0.0).sum(2)
    return points_m.reshape(*views.shape[1:3], 3), (totals / counts.sum(2).clip(1)).sum(0)

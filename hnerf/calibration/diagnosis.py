"""Residuals of keypoints under a calibration, the camera that does not fit the others, and the convention mistake that
explains large residuals."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from hnerf.capture.body_25 import Body25
from hnerf.capture.people import person_heights_px
from hnerf.geometry.camera import Camera, resampling
from hnerf.geometry.triangulation import confidence_of, reprojection_px, solve_points, triangulate

TRIM = 0.8  # share of the residuals that count; the rest are assumed to be detector errors
BODY_HEIGHT_M = (0.5, 2.3)
USUAL_HEIGHT_M = 1.7  # to advise on units, and to place a camera of unknown height; a body fit has a prior of its own
UNITS_M = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "metres declared as millimetres": 1e3}
GROSS_SHARE = 0.05  # of the person's height in the image: beyond this a calibration is wrong, not stale
MISFIT_SHARE = 0.8  # a camera is a misfit if the trimmed cost without it falls below this share
MISFIT_SHARE_OF_THREE = 0.6  # of three cameras: the two that are left agree more easily

MIN_CROSSING_DEG = 10.0  # between lines of sight, below which a point's depth is uncertain

# Ankle-knee, knee-hip, hips-neck and neck-nose make 0.87 of an adult's stature (Winter 2009, figure 4.1).
LIMB_CHAIN = (
    ((Body25.R_ANKLE, Body25.R_KNEE), (Body25.L_ANKLE, Body25.L_KNEE)),
    ((Body25.R_KNEE, Body25.R_HIP), (Body25.L_KNEE, Body25.L_HIP)),
    ((Body25.MID_HIP, Body25.NECK),),
    ((Body25.NECK, Body25.NOSE),),
)
CHAIN_SHARE_OF_STATURE = 0.87

MISTAKES: dict[str, Callable[[Camera], Camera]] = {  # for each mistake, the function that undoes it
    "the extrinsics are camera to world (inverted)": lambda c: dataclasses.replace(c, R=c.R.T, t_m=-c.R.T @ c.t_m),
    "R is transposed": lambda c: dataclasses.replace(c, R=c.R.T),
    "T is the camera's centre": lambda c: dataclasses.replace(c, t_m=-c.R @ c.t_m),
    "the camera axes are OpenGL's (y up, z backward)": lambda c: dataclasses.replace(
        c, R=np.diag([1, -1, -1]) @ c.R, t_m=np.diag([1, -1, -1]) @ c.t_m
    ),
}
# In all cameras at once, these would only scale the world.
SINGLE_CAMERA_MISTAKES: dict[str, Callable[[Camera], Camera]] = {
    f"T is in {unit}": lambda c, metres=metres: dataclasses.replace(c, t_m=metres * c.t_m)  # type: ignore[misc]
    for unit, metres in UNITS_M.items()
}

SIZE_RATIOS = np.geomspace(1 / 5, 5, 161)  # of image sizes, in steps of 2 %
OTHER_SIZE = 1.2  # minimum factor in either direction: closer to 1, a refined K may be as good


@dataclasses.dataclass(frozen=True)
class Measure:
    """Agreement of the cameras on the subject. Per camera by name: median_px, p95_px (robust triangulation) and
    cost_without_px, the trimmed cost of the other cameras (empty with fewer than three cameras). points_m (frames, 25,
    3)."""

    median_px: dict[str, float]
    p95_px: dict[str, float]
    cost_px: float
    cost_without_px: dict[str, float]
    body_height_m: float
    points_m: np.ndarray

    @property
    def misfit(self) -> str | None:
        """Return the camera whose removal lowers the trimmed cost most, if the others agree far better without it;
        else None."""
        share = MISFIT_SHARE_OF_THREE if len(self.cost_without_px) == 3 else MISFIT_SHARE
        worst = min(self.cost_without_px, key=self.cost_without_px.__getitem__, default=None)
        return worst if worst and self.cost_without_px[worst] < share * self.cost_px else None


def measure(cameras: Sequence[Camera], keypoints: np.ndarray) -> Measure:
    """Measure the residuals of keypoints (C, frames, 25, 3) under at least two cameras."""
    points_m, residuals_px = _residuals_px(cameras, keypoints)
    return Measure(
        median_px={name: float(np.median(off_px)) for name, off_px in residuals_px.items()},
        p95_px={name: float(np.percentile(off_px, 95)) for name, off_px in residuals_px.items()},
        cost_px=trimmed_cost_px(cameras, keypoints),
        cost_without_px=cost_without_each_px(cameras, keypoints) if len(cameras) > 2 else {},
        body_height_m=body_height_m(crossed_points(cameras, keypoints, points_m)),
        points_m=points_m,
    )


def _residuals_px(cameras: Sequence[Camera], keypoints: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the points (frames, 25, 3) triangulated from keypoints (C, frames, 25, 3), and by camera the residuals of
    those that it sees. The diagonal of the largest image counts for a point behind the camera, and if it sees none."""
    points_m, residuals_px, _ = triangulate(cameras, keypoints)
    judged = (keypoints[..., 2] > 0) & np.isfinite(points_m).all(-1)
    diagonal_px = max(float(np.hypot(*camera.size_px)) for camera in cameras)
    off_px = np.where(np.isfinite(residuals_px), residuals_px, diagonal_px)
    found = (row[use] if use.any() else np.array([diagonal_px]) for row, use in zip(off_px, judged, strict=True))
    return points_m, dict(zip([camera.name for camera in cameras], found, strict=True))


def crossed_points(cameras: Sequence[Camera], keypoints: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """Return points_m (frames, 25, 3), NaN where the lines of sight to keypoints (C, frames, 25, 3) hardly cross, as
    between two cameras that face each other.

    The products d d^T of two directions at an angle a add up to a matrix of eigenvalues 1 + |cos a|, 1 - |cos a| and 0.
    """
    away_m = np.stack([points_m - camera.centre_m for camera in cameras])
    directions = np.nan_to_num(away_m / np.linalg.norm(away_m, axis=-1, keepdims=True)) * (keypoints[..., 2:] > 0)
    across = np.linalg.eigvalsh(np.einsum("cfkd,cfke->fkde", directions, directions))[..., 1]
    return np.where(across[..., None] >= 1 - np.cos(np.deg2rad(MIN_CROSSING_DEG)), points_m, np.nan)


def trimmed_cost_px(cameras: Sequence[Camera], keypoints: np.ndarray) -> float:
    """Return the mean over cameras of the trimmed mean (lowest four fifths) of the reprojection errors of keypoints (C,
    ..., 3).

    Points are triangulated from all views: no view is rejected and no camera is trimmed away as a whole, so that none
    can hide. A point behind a camera that sees it costs the diagonal of that camera's image.
    """
    projections = np.stack([camera.projection for camera in cameras])
    keypoints = keypoints.reshape(len(cameras), -1, 3)
    seen = keypoints[..., 2] > 0
    points_m = solve_points(projections, keypoints, confidence_of(keypoints))
    diagonal_px = np.array([[np.hypot(*c.size_px)] for c in cameras])
    residuals = np.fmin(reprojection_px(projections, points_m, keypoints), diagonal_px)
    used = seen & (seen.sum(0) >= 2)
    costs = [trimmed_mean(row[use], TRIM) for row, use in zip(residuals, used, strict=True) if use.any()]
    return float(np.mean(costs)) if costs else np.inf


def trimmed_mean(values: np.ndarray, share: float) -> float:
    """Return the mean of the lowest `share` of the finite values; infinity if there are none."""
    ordered = np.sort(values[np.isfinite(values)])
    return float(ordered[: max(1, int(share * len(ordered)))].mean()) if len(ordered) else np.inf


def held_out_parts(keypoints: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield two parts of keypoints (C, frames, 25, 3), one to fit to and one to judge by, and then the other way round.
    They share neither frames nor joints: a detector's systematic error on one joint must not count as proof that a
    camera is wrong. A single frame is split by joints."""
    first, second = np.array_split(keypoints, 2, axis=1) if keypoints.shape[1] > 1 else (keypoints, keypoints)
    first, second = first[:, :, ::2], second[:, :, 1::2]
    yield first, second
    yield second, first


def cost_without_each_px(cameras: Sequence[Camera], keypoints: np.ndarray) -> dict[str, float]:
    """Return the trimmed cost of the other cameras when one is left out, by the left-out camera's name; needs three
    cameras.

    A point in n views leaves 2n - 3 degrees of freedom in 2n residuals; the costs are scaled to be comparable with that
    of all cameras.
    """
    count = len(cameras)
    scale = np.sqrt((2 * count - 3) / (2 * count)) / np.sqrt((2 * count - 5) / (2 * count - 2))
    costs = {}
    for i, camera in enumerate(cameras):
        others = [c for c in range(count) if c != i]
        costs[camera.name] = float(scale * trimmed_cost_px([cameras[c] for c in others], keypoints[others]))
    return costs


def body_height_m(points_m: np.ndarray) -> float:
    """Return the stature from triangulated BODY_25 keypoints (frames, 25, 3), as a sum of median limb lengths, whatever
    the pose; NaN if a limb is never seen."""
    chain = 0.0
    for bones in LIMB_CHAIN:
        lengths = np.concatenate([np.linalg.norm(points_m[:, a] - points_m[:, b], axis=-1) for a, b in bones])
        chain += float(np.median(lengths[np.isfinite(lengths)])) if np.isfinite(lengths).any() else np.nan
    return chain / CHAIN_SHARE_OF_STATURE


def likely_unit(height: float) -> str | None:
    """Return the unit in which a height that is impossible in metres would suit a person; None if there is none."""
    heights_m = {unit: height * metres for unit, metres in UNITS_M.items()}
    possible = [unit for unit, metres in heights_m.items() if BODY_HEIGHT_M[0] <= metres <= BODY_HEIGHT_M[1]]
    return min(possible, key=lambda unit: abs(np.log(heights_m[unit] / USUAL_HEIGHT_M)), default=None)


def gross_limit_px(keypoints: np.ndarray) -> float:
    """Return the trimmed cost beyond which a calibration is wrong rather than stale. keypoints (C, frames, 25, 3)."""
    return GROSS_SHARE * median_height_px(keypoints)


def median_height_px(keypoints: np.ndarray) -> float:
    """Return the person's median height over all images. keypoints (C, frames, 25, 3)."""
    heights = person_heights_px(keypoints.reshape(-1, 25, 3))
    return float(np.median(heights[heights > 0]))


def convention_mistake(cameras: Sequence[Camera], keypoints: np.ndarray) -> str | None:
    """Return the convention mistakes that, undone in all cameras, make the calibration fit keypoints (C, frames, 25,
    3), joined by "or" where the views cannot tell them apart; None if none does."""
    limit_px = gross_limit_px(keypoints)
    explaining = [
        cause for cause, undo in MISTAKES.items() if trimmed_cost_px([undo(c) for c in cameras], keypoints) <= limit_px
    ]
    return " or ".join(explaining) or None


def size_ratio(cameras: Sequence[Camera], keypoints: np.ndarray) -> float | None:
    """Return the factor on all K that makes the calibration fit keypoints (C, frames, 25, 3), as if K was for another
    image size.

    None if the factor is close to 1, if none fits, or if a single camera may be the cause: with three or more cameras,
    if the others agree without it; with two, always.
    """
    limit_px = gross_limit_px(keypoints)
    if len(cameras) < 3 or min(cost_without_each_px(cameras, keypoints).values()) <= limit_px:
        return None
    scaled = ([dataclasses.replace(c, K=resampling(ratio, ratio) @ c.K) for c in cameras] for ratio in SIZE_RATIOS)
    costs_px = [trimmed_cost_px(resized, keypoints) for resized in scaled]
    best = int(np.argmin(costs_px))
    ratio = float(SIZE_RATIOS[best])
    return ratio if costs_px[best] <= limit_px and max(ratio, 1 / ratio) > OTHER_SIZE else None


def undo_mistake(cameras: list[Camera], keypoints: np.ndarray, found: Measure) -> tuple[list[Camera], dict[str, str]]:
    """Return the cameras with one camera's mistake undone, and that mistake by the camera's name, if that alone makes a
    grossly wrong camera fit keypoints (C, frames, 25, 3). Mistakes with the same effect are joined by "or". found: the
    result of `measure` for both."""
    limit_px = gross_limit_px(keypoints)
    gross = [i for i, median_px in enumerate(found.median_px.values()) if median_px > limit_px]
    if len(cameras) < 3 or not gross:
        return cameras, {}
    undone = {
        (i, cause): [*cameras[:i], undo(cameras[i]), *cameras[i + 1 :]]
        for i in gross
        for cause, undo in (MISTAKES | SINGLE_CAMERA_MISTAKES).items()
    }
    residuals_px = {what: _residuals_px(repaired, keypoints)[1].values() for what, repaired in undone.items()}
    medians_px = {what: [np.median(off_px) for off_px in rows] for what, rows in residuals_px.items()}
    costs_px = {what: np.sum(medians) for what, medians in medians_px.items() if max(medians) <= limit_px}
    if not costs_px:
        return cameras, {}
    best = min(costs_px, key=costs_px.__getitem__)
    causes = [cause for (i, cause), cost in costs_px.items() if i == best[0] and np.isclose(cost, costs_px[best])]
    return undone[best], {cameras[best[0]].name: " or ".join(causes)}

"""Silhouette consistency: whether the person's outlines in all cameras belong to one body.

A pixel on the outline of one mask is where a ray touches the person. Somewhere along that ray must be a point that no
other camera sees outside its own mask: a point of the visual hull (Laurentini 1994). The residual is how far the best
point of the ray lies outside, in pixels of the camera that excludes it. It does not depend on keypoints or their bias.
"""

import dataclasses
import logging
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from skimage.measure import find_contours

from hnerf.calibration.diagnosis import trimmed_mean
from hnerf.capture.capture import Capture
from hnerf.capture.subject import subject_keypoints
from hnerf.config import SegmentationSettings
from hnerf.evenly_spaced import evenly_spaced
from hnerf.geometry.camera import Camera
from hnerf.progress import tracked
from hnerf.segmentation.backends import background_subtraction
from hnerf.segmentation.prior import keypoint_priors
from hnerf.side_by_side import side_by_side

FRAMES = 8  # enough to tell that a camera is wrong
PLATE_FRAMES = 24  # from which the background is estimated if there is no clean plate
POINTS = 64  # on the outline in each image
COARSE, FINE = 64, 17  # samples along a ray, and again between the neighbours of the best, twice
SEARCH_RANGE = 1.5  # times the person's size: length of each ray that is searched, in either direction
TRIM = 0.98  # share of the residuals that count; the rest are assumed to be mask errors
MIN_KEYPOINTS_INSIDE = 0.6  # share of the person's keypoints; a mask that holds fewer is not the person's
SLIGHT_CHANGE_PX = 5.0  # maximum change of a ray's distance from the hull when a camera is changed slightly
BEHIND_CAMERA_PX = 1e4  # the residual of a point behind a camera that sees the person

log = logging.getLogger("hnerf.calibration")


@dataclasses.dataclass(frozen=True)
class MaskOutline:
    """Outline of one mask: points_px (n, 2) on it, distance_px (H, W) to it, negative inside; centre_px (2,) of the
    mask; size_px, the diagonal of its bounding box."""

    points_px: np.ndarray
    distance_px: np.ndarray
    centre_px: np.ndarray
    size_px: float

    @staticmethod
    def around(mask: np.ndarray) -> "MaskOutline | None":
        """Return the outline of the largest component of a mask (H, W) bool with its holes filled; None if it is empty.

        There are no outline points where the image border cuts the person off.
        """
        parts, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        if not parts:
            return None
        whole = cv2.drawContours(np.zeros(mask.shape, np.uint8), [max(parts, key=cv2.contourArea)], 0, 1, cv2.FILLED)
        inside = cv2.distanceTransform(whole, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        outside = cv2.distanceTransform(1 - whole, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        distance_px = np.where(whole, 0.5 - inside, outside - 0.5).astype(np.float32)
        edges = find_contours(np.pad(distance_px, 1, constant_values=1e3), 0)
        points = max(edges, key=len)[:-1, ::-1] - 1
        last = np.array(mask.shape[::-1]) - 1
        points = points[((points > 1) & (points < last - 1)).all(1)]
        if len(points) == 0:
            return None
        rows, columns = np.nonzero(whole)
        size_px = float(np.hypot(np.ptp(columns), np.ptp(rows)))
        points = points[evenly_spaced(range(len(points)), POINTS)]
        return MaskOutline(points, distance_px, np.array([columns.mean(), rows.mean()]), size_px)


@dataclasses.dataclass(frozen=True)
class Outlines:
    """Outlines of the person by camera, one per instant; None if a camera has no mask then.

    instants: their indices in `capture.frames`.
    """

    by_camera: Mapping[str, Sequence[MaskOutline | None]]
    instants: tuple[int, ...]

    @staticmethod
    def of(capture: Capture, frames: int = FRAMES) -> "Outlines | None":
        """Return the outlines of the training cameras at this many evenly spaced frames, from given masks, clean plates
        or a median of the images.

        The masks use each camera's own keypoints only, so that a wrong calibration cannot spoil them. Returns None if
        fewer than two cameras have a usable mask.
        """
        found = subject_keypoints(capture)
        everyone = np.all([(seen[..., 2] > 0).any(1) for seen in found.values()], axis=0)
        shown = evenly_spaced(np.flatnonzero(everyone).tolist(), frames)
        log.info("outlines of %d cameras at %d instants", len(found), len(shown))
        each = side_by_side(lambda name: _outlines(capture, name, found[name], shown), found)
        by_camera = dict(zip(found, tracked(each, "outlines", len(found)), strict=True))
        usable = {name: outlines for name, outlines in by_camera.items() if any(outlines)}
        return Outlines(usable, tuple(shown)) if len(usable) > 1 else None

    def select(self, positions: slice) -> "Outlines":
        """Return the outlines of some instants, by their positions in `instants`."""
        return Outlines({name: row[positions] for name, row in self.by_camera.items()}, self.instants[positions])

    def cost_px(self, cameras: Sequence[Camera]) -> float:
        """Return the mean of the lowest 98 % of all residuals under at least two cameras.

        Most rays pass through the middle of the hull and cannot miss it: with exact masks a correct rig costs almost
        nothing, and one with a camera turned by a degree a few tenths of a pixel.
        """
        return trimmed_mean(np.concatenate(list(self.residuals_px(cameras).values())), TRIM)

    def residuals_px(self, cameras: Sequence[Camera]) -> dict[str, np.ndarray]:
        """Return, per camera, how far the rays of its outline miss the other cameras' visual hull, (n,) pixels >= 0.

        Cameras without outlines are left out, as are instants at which fewer than two cameras have one.
        """
        return self.near_hull(cameras).residuals_px()

    def near_hull(self, cameras: Sequence[Camera]) -> "NearHull":
        """Return where the rays of each camera's outlines pass the hull of the others, at instants with at least two
        outlines."""
        known = [camera for camera in cameras if camera.name in self.by_camera]
        found: dict[str, list[_RaysNearHull]] = {camera.name: [] for camera in known}
        for instant in range(len(self.instants)):
            at_once = [(camera, self.by_camera[camera.name][instant]) for camera in known]
            seen = {camera.name: (camera, outline) for camera, outline in at_once if outline is not None}
            if len(seen) < 2:
                continue
            centre_m, reach_m = _locate_person(list(seen.values()))
            for name in seen:
                found[name].append(_RaysNearHull.of(name, seen, centre_m, reach_m))
        return NearHull(found)


@dataclasses.dataclass(frozen=True)
class NearHull:
    """Where the rays of outlines pass the hull, by camera, one entry per instant."""

    by_camera: Mapping[str, Sequence["_RaysNearHull"]]

    def residuals_px(self) -> dict[str, np.ndarray]:
        """Return what `Outlines.residuals_px` does."""
        found = {name: [near.closest_px().clip(0) for near in rows] for name, rows in self.by_camera.items()}
        return {name: np.concatenate(rows) if rows else np.zeros(0) for name, rows in found.items()}

    def changes_px(self, replacements: Sequence[Sequence[Camera]]) -> np.ndarray:
        """Return the changes of all `residuals_px`, concatenated over cameras, for each replacement of some cameras by
        slightly different ones of the same names: (replacements, n). Only rays that do not pass deep inside the hull
        are searched, and only where they passed it closest before."""
        near_hull = [near for rows in self.by_camera.values() for near in rows]
        if not near_hull:
            return np.zeros((len(replacements), 0))
        before_px = np.concatenate([near.closest_px() for near in near_hull])
        close = before_px > -SLIGHT_CHANGE_PX
        parts = np.split(close, np.cumsum([len(near.along_m) for near in near_hull])[:-1])
        searched = [near.select(part) for near, part in zip(near_hull, parts, strict=True)]
        changed_px = np.zeros((len(replacements), len(close)))
        for i, replaced in enumerate(replacements):
            after_px = np.concatenate([near.replaced(replaced).closest_px() for near in searched])
            changed_px[i, close] = after_px.clip(0) - before_px[close].clip(0)
        return changed_px


@dataclasses.dataclass(frozen=True)
class _RaysNearHull:
    """Samples of the rays of one camera's outline, where they pass the hull of the other cameras closest.

    name: of the camera; seen: cameras and outlines of that instant, by name; along_m (n, FINE): distances of the
    samples from the camera; points_m (n, FINE, 3): the samples; outside_px: the result of `_outside_px` for them, by
    the name of the other camera.
    """

    name: str
    seen: Mapping[str, tuple[Camera, MaskOutline]]
    along_m: np.ndarray
    points_m: np.ndarray
    outside_px: Mapping[str, np.ndarray]

    @staticmethod
    def of(
        name: str, seen: Mapping[str, tuple[Camera, MaskOutline]], centre_m: np.ndarray, reach_m: float
    ) -> "_RaysNearHull":
        """Search the rays of a camera within `reach_m` of their points closest to the centre."""
        camera, outline = seen[name]
        rays = origins, directions = camera.rays(outline.points_px)
        nearest_m = ((centre_m - origins) * directions).sum(-1, keepdims=True)
        step_m = 2 * reach_m / (COARSE - 1)
        near = _RaysNearHull._at(name, seen, rays, (nearest_m + np.linspace(-reach_m, reach_m, COARSE)).clip(step_m))
        for _ in range(2):
            best_m = np.take_along_axis(near.along_m, near._outside_hull_px().argmin(1)[:, None], 1)
            near = _RaysNearHull._at(name, seen, rays, best_m + np.linspace(-step_m, step_m, FINE))
            step_m *= 2 / (FINE - 1)
        return near

    @staticmethod
    def _at(
        name: str,
        seen: Mapping[str, tuple[Camera, MaskOutline]],
        rays: tuple[np.ndarray, np.ndarray],
        along_m: np.ndarray,
    ) -> "_RaysNearHull":
        """Sample the rays of a camera, origins and directions (n, 3), at distances (n, S)."""
        origins, directions = rays
        points_m = origins[:, None] + along_m[..., None] * directions[:, None]
        outside_px = {other: _outside_px(*seen[other], points_m) for other in seen if other != name}
        return _RaysNearHull(name, seen, along_m, points_m, outside_px)

    def replaced(self, cameras: Sequence[Camera]) -> "_RaysNearHull":
        """Return the samples with the cameras of these names replaced; if the rays change, the points on them closest
        to the samples."""
        changed = {c.name: (c, self.seen[c.name][1]) for c in cameras if c.name in self.seen}
        seen = {**self.seen, **changed}
        if self.name in changed:
            camera, outline = changed[self.name]
            rays = origins, directions = camera.rays(outline.points_px)
            along_m = ((self.points_m - origins[:, None]) * directions[:, None]).sum(-1)
            return _RaysNearHull._at(self.name, seen, rays, along_m)
        outside_px = {**self.outside_px, **{name: _outside_px(*of, self.points_m) for name, of in changed.items()}}
        return dataclasses.replace(self, seen=seen, outside_px=outside_px)

    def select(self, rays: np.ndarray) -> "_RaysNearHull":
        """Return the samples of some of the rays, (n,) bool."""
        camera, outline = self.seen[self.name]
        seen = {**self.seen, self.name: (camera, dataclasses.replace(outline, points_px=outline.points_px[rays]))}
        outside_px = {name: px[rays] for name, px in self.outside_px.items()}
        return _RaysNearHull(self.name, seen, self.along_m[rays], self.points_m[rays], outside_px)

    def closest_px(self) -> np.ndarray:
        """Return how far from the hull each ray passes at its closest, (n,) pixels, negative inside."""
        return self._outside_hull_px().min(1)

    def _outside_hull_px(self) -> np.ndarray:
        """Return how far the samples lie outside the mask that excludes them most, (n, S) pixels."""
        return np.maximum.reduce(list(self.outside_px.values()))


def _locate_person(seen: Sequence[tuple[Camera, MaskOutline]]) -> tuple[np.ndarray, float]:
    """Return the point (3,) closest to the rays through the centres of the masks, and the person's size around it in
    metres."""
    origins, directions = zip(*(camera.rays(outline.centre_px) for camera, outline in seen), strict=True)
    across = np.stack([np.eye(3) - np.outer(d, d) for d in directions])  # projects onto the plane across the ray
    towards = np.einsum("cij,cj->i", across, np.stack(origins))
    centre_m = np.linalg.lstsq(across.sum(0), towards, rcond=None)[0]
    sizes_m = [
        outline.size_px / camera.K[1, 1] * float(np.linalg.norm(centre_m - camera.centre_m)) for camera, outline in seen
    ]
    return centre_m, SEARCH_RANGE * float(np.median(sizes_m))


def _outside_px(camera: Camera, outline: MaskOutline, points_m: np.ndarray) -> np.ndarray:
    """Return how far points (n, S, 3) lie outside a mask, (n, S) pixels, negative inside.

    Beyond the image border the nearest border pixel counts: a person whom the border cuts off may continue there.
    """
    uv, depth_m = camera.project(points_m)
    at = np.fmin(np.fmax(uv, -BEHIND_CAMERA_PX), BEHIND_CAMERA_PX).astype(np.float32)
    x, y = cv2.split(at)
    far_px = cv2.remap(outline.distance_px, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(depth_m > 0, far_px, BEHIND_CAMERA_PX)


def _outlines(capture: Capture, name: str, keypoints: np.ndarray, shown: Sequence[int]) -> list[MaskOutline | None]:
    """Return one camera's outlines at the frames of these indices; keypoints (frames, 25, 3) of the subject."""
    outlines = []
    for i, mask in zip(shown, _masks(capture, name, keypoints, shown), strict=True):
        xy = keypoints[i, keypoints[i, :, 2] > 0, :2].round().astype(int)
        xy = xy[((xy >= 0) & (xy < mask.shape[::-1])).all(1)]
        covered = mask[xy[:, 1], xy[:, 0]].mean() if len(xy) else 0.0
        outlines.append(MaskOutline.around(mask) if covered >= MIN_KEYPOINTS_INSIDE else None)
    return outlines


def _masks(capture: Capture, name: str, keypoints: np.ndarray, shown: Sequence[int]) -> list[np.ndarray]:
    """Return the masks (H, W) bool of the person with keypoints (frames, 25, 3) in one camera, at the frames of these
    indices."""
    given = [capture.given_mask(name, capture.frames[i]) for i in shown]
    if all(mask is not None for mask in given):
        return [mask for mask in given if mask is not None]
    prior_of = keypoint_priors(capture, name, keypoints, SegmentationSettings())
    mask_of = background_subtraction(capture, name, prior_of, PLATE_FRAMES)
    return [mask_of(capture.frames[i], prior_of(i)) for i in shown]

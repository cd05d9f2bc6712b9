"""Pixels of a camera in which a posed body, with a margin, can be seen."""

import itertools
from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float

from hnerf.geometry.camera import Camera

NEAREST_PERCENT = 1  # percentile of vertex depths that sets the radius, so that one finger does not widen all discs
FARTHEST_PX = 1e5  # largest coordinate of a corner; OpenCV fills polygons of small integers only
ReachablePixels = Callable[[Camera, Float[np.ndarray, "V 3"]], Bool[np.ndarray, "H W"]]
"""Returns which pixels of a camera can show any part of a body with these vertices."""


def everywhere(camera: Camera, vertices_m: Float[np.ndarray, "V 3"]) -> Bool[np.ndarray, "H W"]:
    """Return all pixels of the camera: nothing is excluded."""
    return np.ones((camera.height_px, camera.width_px), bool)


def within_box(camera: Camera, vertices_m: Float[np.ndarray, "V 3"], margin_m: float) -> Bool[np.ndarray, "H W"]:
    """Return the pixels whose rays meet the bounding box of the body with a margin; all pixels if part of the box lies
    behind the camera or nearly in its plane."""
    lower_m, upper_m = vertices_m.min(0) - margin_m, vertices_m.max(0) + margin_m
    corners_px, depth_m = camera.project(np.array(list(itertools.product(*zip(lower_m, upper_m, strict=True)))))
    if depth_m.min() <= 0 or np.abs(corners_px).max() > FARTHEST_PX:
        return everywhere(camera, vertices_m)
    met = np.zeros((camera.height_px, camera.width_px), np.uint8)
    outline = cv2.convexHull(corners_px.round().astype(np.int32))
    return cv2.fillConvexPoly(met, outline, 1) > 0


def within_reach(camera: Camera, vertices_m: Float[np.ndarray, "V 3"], reach_m: float) -> Bool[np.ndarray, "H W"]:
    """Return the pixels whose rays pass within about `reach_m` of the body.

    Take a point at depth z that projects to v, and the ray through pixel p, at an angle a from the optical axis. Their
    distance is at least z |p - v| cos(a), with p and v in focal lengths; it is equal if p, v and the principal point
    are collinear. So each vertex in front of the camera, inside or outside the image, covers the pixels closer than
    reach_m / (z cos(a)); the z of the nearest vertices is used for all.
    """
    size_px = np.array(camera.size_px)
    xy, depth_m = camera.project(vertices_m)
    xy, depth_m = xy[depth_m > 0], depth_m[depth_m > 0]
    if not len(depth_m):
        return np.zeros(size_px[::-1], bool)
    nearest_m, focal_px = np.percentile(depth_m, NEAREST_PERCENT), max(camera.K[0, 0], camera.K[1, 1])
    across_px = np.hypot(*size_px)
    radius = int(np.ceil(min(reach_m * focal_px / nearest_m, across_px)))
    x, y = (((np.arange(n) - camera.K[k, 2]) / camera.K[k, k]).astype(np.float32) for k, n in enumerate(size_px))
    # 1 / cos(a) is the length of the ray at a depth of 1.
    radii = np.minimum(radius * np.sqrt(1 + x**2 + y[:, None] ** 2), across_px)
    margin = int(np.ceil(radii.max()))
    xy = np.round(xy) + margin
    x, y = xy[((xy >= 0) & (xy < size_px + 2 * margin)).all(1)].astype(int).T
    outside = np.ones(size_px[::-1] + 2 * margin, np.uint8)
    outside[y, x] = 0
    distance_px = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return distance_px[margin:-margin, margin:-margin] <= radii

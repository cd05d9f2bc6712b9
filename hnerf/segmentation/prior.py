"""Priors on the subject's position in an image, from keypoints or a fitted body."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from hnerf.body.fit_result import BodyFit
from hnerf.capture.body_25 import FEET, LEFT_FOOT, LEFT_LEG, LIMBS, RIGHT_FOOT, RIGHT_LEG, Body25
from hnerf.capture.capture import Capture
from hnerf.capture.people import person_heights_px
from hnerf.capture.subject import subject_keypoints
from hnerf.capture.timing import median_step
from hnerf.config import SegmentationSettings
from hnerf.geometry.camera import Camera
from hnerf.geometry.silhouette import silhouette
from hnerf.geometry.triangulation import triangulate

TRUNK = (Body25.R_SHOULDER, Body25.L_SHOULDER, Body25.L_HIP, Body25.R_HIP)
# Drawn twice as thick as other limbs: the trunk, for side views, and thighs
THICK = ((Body25.NECK, Body25.MID_HIP), RIGHT_LEG[0], LEFT_LEG[0])
CORE_SHARE = 0.02  # of the person's height: half the width of a limb that is surely body
MARGIN_PX = 12  # of background around the person
NEAR_SHARE = 0.03  # of the person's height: error of a body fitted to keypoints alone
SOLE_SHARE = 0.06  # of the person's height: extent of a shoe below the lowest keypoint
UPRIGHT = 0.7  # minimum cosine between the image's and the world's vertical in an upright image
HEAD_SHARE = 0.45  # of the distance from neck to nose: radius of the head about a point a little above the nose
LIKELY, SURE = 0.5, 0.9  # probabilities of a network above which a pixel is likely, or surely, the person's
FAR = 5  # in longer sides of the image, beyond which nothing is drawn
FACE = (Body25.R_EYE, Body25.L_EYE, Body25.R_EAR, Body25.L_EAR)
SHOULDERS, HIP_WIDTH = (Body25.R_SHOULDER, Body25.L_SHOULDER), 0.8  # of the shoulders' width, for unseen hips
LEGS = (
    (Body25.R_HIP, Body25.R_KNEE, Body25.R_ANKLE, RIGHT_FOOT),
    (Body25.L_HIP, Body25.L_KNEE, Body25.L_ANKLE, LEFT_FOOT),
)
NOSE_ABOVE_NECK, THIGH = 0.45, 0.8  # of the distance from neck to mid-hip, to place unseen joints
FOOT_SHARE = 0.1  # of the person's height: extent of an unseen foot around its ankle


@dataclass(frozen=True)
class Prior:
    """What is known about the person in one image before looking at it. height_px: the person's, 0 if nothing is seen
    or if the person is `behind` the camera.

    (H, W) bool, each within the next: `core`, surely the person; `body`, as fitted; `near`, the area that a slightly
    wrong body may cover; `reach`, the farthest extent of clothes and hair.
    """

    core: np.ndarray
    body: np.ndarray
    near: np.ndarray
    reach: np.ndarray
    height_px: float
    behind: bool = False

    @property
    def elsewhere(self) -> bool:
        """Return whether the person is known to be outside the image."""
        return (self.height_px > 0 or self.behind) and not self.reach.any()

    def cropped(self, window: tuple[slice, slice]) -> "Prior":
        """Return the same prior within a window of the image."""
        core, body, near, reach = (part[window] for part in (self.core, self.body, self.near, self.reach))
        return Prior(core, body, near, reach, self.height_px, self.behind)


PriorOf = Callable[[int], Prior]
"""Makes the prior of the frame of this number among `capture.frames`: those of a long recording do not fit into memory
together."""


def camera_priors(
    capture: Capture, body: BodyFit | None, settings: SegmentationSettings
) -> Iterator[tuple[str, PriorOf]]:
    """Yield each training camera with priors from the fitted body, else from a network's person masks, either together
    with the stick figure, parts of which they may miss; else from the stick figure alone."""
    prior: Callable[..., Prior] = _network_prior if capture.has_person_masks else _keypoint_prior
    if body is not None:
        vertices_m = body.vertices_m().numpy()[[body.index(f) for f in capture.frames]]
        prior = partial(_body_prior, vertices_m=vertices_m, faces=body.rig.faces.numpy())
    for name, poses_px in _consistent_keypoints(capture, body).items():
        yield name, partial(prior, capture, name, poses_px, settings.reach)


def keypoint_priors(capture: Capture, camera: str, keypoints: np.ndarray, settings: SegmentationSettings) -> PriorOf:
    """Return priors from a person's stick figures in one camera, drawn from keypoints (frames, 25, 3)."""
    poses_px = _interpolated(np.where(keypoints[..., 2:] > 0, keypoints[..., :2], np.nan), capture.frames)
    return partial(_keypoint_prior, capture, camera, poses_px, settings.reach)


def _keypoint_prior(capture: Capture, camera: str, poses_px: np.ndarray, reach: float, number: int) -> Prior:
    stick = _stick_figure(capture.cameras[camera], poses_px[number])
    return _grown(capture, camera, stick, stick.core, stick.body, stick.completed, reach)


def _body_prior(
    capture: Capture, camera: str, poses_px: np.ndarray, reach: float, number: int, vertices_m: np.ndarray,
    faces: np.ndarray,
) -> Prior:  # fmt: skip
    stick = _stick_figure(capture.cameras[camera], poses_px[number])
    covered = silhouette(capture.cameras[camera], vertices_m[number], faces)
    body = covered | stick.body
    return _grown(capture, camera, stick, _core(covered, stick.height_px), body, body, reach / 2)


def _network_prior(capture: Capture, camera: str, poses_px: np.ndarray, reach: float, number: int) -> Prior:
    """Return the prior from a network's person mask, restricted to the subject."""
    likely = capture.person_probability(camera, capture.frames[number])
    assert likely is not None  # networks process every image of a training camera
    figure = _keypoint_prior(capture, camera, poses_px, reach, number)
    covered = (likely > LIKELY) & figure.reach
    if not covered.any():  # the network missed the person in this image
        return figure
    core = _core(likely > SURE, figure.height_px)
    body = covered | figure.core
    return _grown(capture, camera, figure, core & covered, body, body, reach / 2)


def _grown(
    capture: Capture, camera: str, figure: "Prior | _StickFigure", core: np.ndarray, body: np.ndarray,
    completed: np.ndarray, reach: float,
) -> Prior:  # fmt: skip
    """Return the prior grown around the body, seen and completed, (H, W) bool; reach in heights of the person.

    In an image whose rows run downwards in the world, anything far below the lowest part of the body is its reflection
    and is excluded.
    """
    away_px = cv2.distanceTransform((~completed).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    within = away_px <= reach * figure.height_px
    upright = -capture.cameras[camera].R[1, "xyz".index(capture.up)] > UPRIGHT
    if upright and completed.any():
        within[int(np.flatnonzero(completed.any(1))[-1] + SOLE_SHARE * figure.height_px) + 1 :] = False
    near = within & (away_px <= NEAR_SHARE * figure.height_px)
    return Prior(core, body, near, within, figure.height_px, figure.behind)


def _core(covered: np.ndarray, height_px: float) -> np.ndarray:
    """Return the pixels deep enough inside (H, W) bool to be surely a limb, in time independent of the person's
    size."""
    depth_px = cv2.distanceTransform(covered.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(depth_px > max(1, round(CORE_SHARE * height_px)))


def bounding_window(region: np.ndarray) -> tuple[slice, slice]:
    """Return rows and columns of the True pixels of (H, W) with a margin of background; empty if there are none."""
    rows, columns = np.flatnonzero(region.any(1)), np.flatnonzero(region.any(0))
    if len(rows) == 0:
        return slice(0), slice(0)
    return (
        slice(max(0, rows[0] - MARGIN_PX), rows[-1] + 1 + MARGIN_PX),
        slice(max(0, columns[0] - MARGIN_PX), columns[-1] + 1 + MARGIN_PX),
    )


def disc(radius_px: float) -> np.ndarray:
    """Return the structuring element of this radius, at least 1 px."""
    side = 2 * max(1, round(radius_px)) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def _consistent_keypoints(capture: Capture, body: BodyFit | None) -> dict[str, np.ndarray]:
    """Return keypoints (frames, 25, 2) in pixels by camera; NaN for a keypoint that is never seen.

    If several cameras see the person, keypoints are triangulated and projected, which removes a detector's outliers;
    gaps in time are interpolated; keypoints that no two cameras ever see together stay as each camera has them. If the
    recording has no keypoints, the body's own are used. Points behind a camera are infinite.
    """
    if body is not None and not capture.has_keypoints:
        points_m = (body.rig.keypoint_weights @ body.vertices_m()).numpy()
        own = np.full((*points_m.shape[:-1], 2), np.nan)
        return {name: _in_image(capture.cameras[name], points_m, own) for name in capture.train_cameras}
    found = subject_keypoints(capture)
    tracks_px = {name: np.where(k[..., 2:] > 0, k[..., :2], np.nan) for name, k in found.items()}
    seen = {name: _interpolated(tracks, capture.frames) for name, tracks in tracks_px.items()}
    cameras = [capture.cameras[name] for name in capture.train_cameras]
    if len(cameras) == 1:
        return seen
    points_m, _, _ = triangulate(cameras, np.stack([found[camera.name] for camera in cameras]))
    poses_m = _interpolated(points_m, capture.frames)
    return {camera.name: _in_image(camera, poses_m, seen[camera.name]) for camera in cameras}


def _in_image(camera: Camera, points_m: np.ndarray, own_px: np.ndarray) -> np.ndarray:
    """Return the pixels (..., 2) of points (..., 3): those in own_px (..., 2) where a point is unknown, infinity where
    it is behind the camera."""
    pixels_px, depth_m = camera.project(points_m)
    return np.where(depth_m[..., None] <= 0, np.inf, np.where(np.isfinite(pixels_px), pixels_px, own_px))


def _interpolated(tracks: np.ndarray, frames: Sequence[int]) -> np.ndarray:
    """Return tracks (frames, 25, D) with NaN gaps filled linearly in time, by the frames' numbers: the mid-hip's
    absolute position, all others' relative to it."""
    at = (np.array(frames) - frames[0]) / median_step(frames)
    hip = _filled(tracks[:, [Body25.MID_HIP]], at)
    origin = hip if np.isfinite(hip).all() else np.zeros_like(hip)
    return origin + _filled(tracks - origin, at)


def _filled(tracks: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return tracks (frames, ...) with NaN gaps filled linearly between instants `at` (frames,)."""
    filled = tracks.copy()
    for track in filled.reshape(len(tracks), -1).T:
        known = np.isfinite(track)
        if known.any():
            track[~known] = np.interp(at[~known], at[known], track[known])
    return filled


def _completed_pose(pose_px: np.ndarray) -> np.ndarray:
    """Return a pose (25, 2) in which unseen head, hips and legs are placed where they are likely, in line with the
    visible joints."""
    completed = pose_px.copy()

    def fill(joint: int, at_px: np.ndarray) -> None:
        if not np.isfinite(completed[joint]).all():
            completed[joint] = at_px

    face = [k for k in FACE if np.isfinite(pose_px[k]).all()]
    if face:
        fill(Body25.NOSE, pose_px[face].mean(0))
    neck_px = pose_px[Body25.NECK]
    fill(Body25.MID_HIP, neck_px + (neck_px - completed[Body25.NOSE]) / NOSE_ABOVE_NECK)
    middle_px = completed[Body25.MID_HIP]
    trunk_px = middle_px - neck_px
    fill(Body25.NOSE, neck_px - NOSE_ABOVE_NECK * trunk_px)
    for shoulder, (hip, knee, ankle, _) in zip(SHOULDERS, LEGS, strict=True):
        fill(hip, middle_px + HIP_WIDTH * (pose_px[shoulder] - neck_px))
        fill(hip, middle_px)
        fill(knee, completed[hip] + THIGH * trunk_px)
        fill(ankle, 2 * completed[knee] - completed[hip])
    return completed


@dataclass(frozen=True)
class _StickFigure:
    """A drawn stick figure, (H, W) bool: core, without the feet, where shadows touch the person; body, with the feet;
    completed, also with parts that no keypoint shows. behind: whether all known points are behind the camera."""

    core: np.ndarray
    body: np.ndarray
    completed: np.ndarray
    height_px: float
    behind: bool


def _stick_figure(camera: Camera, pose_px: np.ndarray) -> _StickFigure:
    """Draw the stick figure of pose_px (25, 2), NaN where unknown, infinite behind the camera. It is clipped far
    outside the image, as drawing takes small integers."""
    far_px = FAR * max(camera.size_px)
    behind = np.isinf(pose_px)
    pose_px = np.where(behind, np.nan, pose_px.clip(-far_px, far_px))
    whole_px = _completed_pose(pose_px)
    known = np.isfinite(whole_px).all(-1, keepdims=True)
    height_px = float(person_heights_px(np.concatenate([np.nan_to_num(whole_px), known], -1)))
    core, body = _drawn(camera, pose_px, height_px)
    completed = _drawn(camera, whole_px, height_px)[1].astype(np.uint8)
    for _, _, ankle, foot in LEGS:
        if known[ankle] and not np.isfinite(pose_px[list(foot)]).any():
            cv2.circle(completed, _pixel(whole_px[ankle]), round(FOOT_SHARE * height_px), 1, cv2.FILLED)
    return _StickFigure(core, body, body | completed.astype(bool), height_px, bool(behind.any() and not known.any()))


def _drawn(camera: Camera, pose_px: np.ndarray, height_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Draw limbs as thick lines, the trunk as a polygon, the head as a disc, (H, W) bool: without feet and with
    them."""
    seen = np.isfinite(pose_px).all(-1)
    image = np.zeros((camera.height_px, camera.width_px), np.uint8)
    width_px = max(1, round(2 * CORE_SHARE * height_px))

    def draw(limbs: tuple[tuple[int, int], ...], times: int = 1) -> np.ndarray:
        for a, b in limbs:
            if seen[a] and seen[b]:
                cv2.line(image, _pixel(pose_px[a]), _pixel(pose_px[b]), 1, times * width_px)
        return image.astype(bool)

    if seen[list(TRUNK)].all():
        cv2.fillConvexPoly(image, cv2.convexHull(np.array([_pixel(pose_px[k]) for k in TRUNK])), 1)
    if seen[Body25.NOSE] and seen[Body25.NECK]:
        nose_px = pose_px[Body25.NOSE]
        up_px = nose_px - pose_px[Body25.NECK]
        radius_px = round(HEAD_SHARE * float(np.linalg.norm(up_px)) + CORE_SHARE * height_px)
        cv2.circle(image, _pixel(nose_px + 0.15 * up_px), radius_px, 1, cv2.FILLED)
    draw(THICK, times=2)
    return draw(LIMBS), draw(FEET)


def _pixel(at_px: np.ndarray) -> tuple[int, int]:
    """Return the nearest pixel as integers."""
    x, y = at_px.round().astype(int).tolist()
    return x, y

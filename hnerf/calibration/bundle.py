"""Bundle adjustment of camera poses with the keypoints of the person as wand points (Ceres, through pycolmap)."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from hnerf.capture.lens import pinhole, undistort_keypoints
from hnerf.evenly_spaced import evenly_spaced
from hnerf.geometry.camera import Camera
from hnerf.geometry.triangulation import reprojection_px, triangulate
from hnerf.pycolmap_import import pycolmap

ROUNDS = 3  # of triangulation and adjustment, each with the cameras of the one before
LOSS_SCALE_PX = 2.0  # about the noise of a keypoint detector
MIN_OBSERVATIONS = 50  # fewer mean that the cameras do not agree on any points to adjust to
FUNCTION_TOLERANCE = 1e-6  # relative change of the cost at which a solve ends
MAX_FRAMES = 100  # evenly spaced; a hundred body poses determine a camera well


def adjust(
    cameras: Sequence[Camera], keypoints: np.ndarray, free: Sequence[str], focal: Sequence[str] = ()
) -> list[Camera]:
    """Return the cameras with adjusted poses (those named in `free`) and focal lengths (those named in `focal`), fitted
    to keypoints (C, frames, K, 3). The pixel aspect ratio stays.

    If at least two other cameras are fixed, they alone triangulate the points, and every keypoint of a free camera
    counts, however far off. If all cameras are free, the adjusted rig is aligned to the given cameras by a similarity
    transform, so that the world frame stays.
    """
    chosen = evenly_spaced(range(keypoints.shape[1]), MAX_FRAMES)
    flat = keypoints[:, chosen].reshape(len(cameras), -1, 3)
    freed = np.array([camera.name in free for camera in cameras])
    reference = ~freed if (~freed).sum() >= 2 else np.ones_like(freed)
    reference_keypoints = flat.copy()
    reference_keypoints[~reference, :, 2] = 0
    adjusted = list(cameras)
    for _ in range(ROUNDS):
        points_m, _, inliers = triangulate(adjusted, reference_keypoints)
        residuals_px = reprojection_px(np.stack([camera.projection for camera in adjusted]), points_m, flat)
        used = inliers | (~reference[:, None] & (flat[..., 2] > 0) & np.isfinite(residuals_px))
        if used.sum() < MIN_OBSERVATIONS:
            break
        adjusted, _ = _bundle_adjust(adjusted, flat, points_m, used, residuals_px, free, focal)
    return align(adjusted, cameras) if freed.all() else adjusted


def adjust_shared_lens(
    cameras: Sequence[Camera], keypoints: np.ndarray, unknown: Sequence[str], distorted: bool
) -> tuple[list[Camera], float]:
    """Return the cameras with all poses adjusted and the focal lengths of those named in `unknown` multiplied by one
    factor, and their common distortion term k1 (0 unless `distorted`). The rig is aligned to the given cameras.

    keypoints (C, frames, K, 3). Focal lengths of one lens model differ by a percent or two, too little for a single
    camera to distinguish from a step towards the person.
    """
    chosen = evenly_spaced(range(keypoints.shape[1]), MAX_FRAMES)
    flat = keypoints[:, chosen].reshape(len(cameras), -1, 3)
    names, side = [camera.name for camera in cameras], max(max(camera.size_px) for camera in cameras)
    adjusted, k1 = list(cameras), 0.0
    for _ in range(ROUNDS):
        points_m, residuals_px, used = triangulate(adjusted, undistort(flat, adjusted, unknown, k1))
        if used.sum() < MIN_OBSERVATIONS:
            break
        focal_px = float(np.median([camera.K[0, 0] for camera in adjusted]))
        model, params = ("SIMPLE_RADIAL", [focal_px, 0, 0, k1]) if distorted else ("SIMPLE_PINHOLE", [focal_px, 0, 0])
        lens = pycolmap.Camera(camera_id=len(cameras) + 1, model=model, params=params, width=side, height=side)
        adjusted, scene = _bundle_adjust(adjusted, flat, points_m, used, residuals_px, names, unknown, lens)
        k1 = float(scene.camera(lens.camera_id).params[3]) if distorted else 0.0
    return align(adjusted, cameras), k1


def undistort(keypoints: np.ndarray, cameras: Sequence[Camera], unknown: Sequence[str], k1: float) -> np.ndarray:
    """Return keypoints (C, ..., 3) without the distortion k1 (OpenCV's) of the cameras named in `unknown`."""
    straight = keypoints.copy()
    for i, camera in enumerate(cameras):
        if camera.name in unknown and k1:
            seen = keypoints[i, ..., 2] > 0
            lens = dataclasses.replace(pinhole(camera), distortion=np.array([k1, 0, 0, 0]))
            straight[i, seen] = undistort_keypoints(keypoints[i, seen], lens)
    return straight


def _bundle_adjust(
    cameras: Sequence[Camera],
    keypoints: np.ndarray,
    points_m: np.ndarray,
    used: np.ndarray,
    residuals_px: np.ndarray,
    free: Sequence[str],
    focal: Sequence[str],
    common: pycolmap.Camera | None = None,
) -> tuple[list[Camera], pycolmap.Reconstruction]:
    """Solve once over the used observations (C, K): each (frame, joint) is a point, each camera one image. common: the
    lens of all cameras named in `focal`, if they share one. Return the cameras and the solved scene."""
    scene = pycolmap.Reconstruction()
    config = pycolmap.BundleAdjustmentConfig()
    if common is not None:
        scene.add_camera_with_trivial_rig(common)
    lenses = [common if camera.name in focal else None for camera in cameras]
    for i, (camera, lens) in enumerate(zip(cameras, lenses, strict=True), start=1):
        _add_image(scene, i, camera, keypoints[i - 1, :, :2], lens)
        config.add_image(i)
        if camera.name not in free:
            config.set_constant_rig_from_world_pose(i)
        if camera.name not in focal:
            config.set_constant_cam_intrinsics(i)
    if len(cameras) - len(free) < 2:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    for k in np.flatnonzero(used.sum(0) >= 2):
        track = [pycolmap.TrackElement(int(c) + 1, int(k)) for c in np.flatnonzero(used[:, k])]
        scene.add_point3D(points_m[k], pycolmap.Track(track))
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = max(LOSS_SCALE_PX, float(np.median(residuals_px[used])))
    options.ceres.solver_options.function_tolerance = FUNCTION_TOLERANCE
    pycolmap.create_default_ceres_bundle_adjuster(options, config, scene).solve()
    solved = [
        _as_solved(scene, i, camera, lens) if camera.name in free else camera
        for i, (camera, lens) in enumerate(zip(cameras, lenses, strict=True), start=1)
    ]
    return solved, scene


def _add_image(
    scene: pycolmap.Reconstruction,
    number: int,
    camera: Camera,
    keypoints_px: np.ndarray,
    lens: pycolmap.Camera | None,
) -> None:
    """Add an image to the scene, moved and scaled to a lens that is there. If the lens is None, add the camera's own,
    with one focal length: y is scaled by the pixel aspect ratio fx / fy, and skew is removed."""
    fx, fy, centre_px = camera.K[0, 0], camera.K[1, 1], camera.K[:2, 2]
    if lens is not None:
        points = (keypoints_px - centre_px) * (lens.params[0] / np.array([fx, fy]))
    else:
        aspect = np.array([1, fx / fy])
        points = keypoints_px.copy()
        points[:, 0] -= camera.K[0, 1] / fy * (keypoints_px[:, 1] - centre_px[1])
        points *= aspect
        lens = pycolmap.Camera(
            camera_id=number,
            model="SIMPLE_PINHOLE",
            params=[fx, *(centre_px * aspect)],
            width=camera.width_px,
            height=camera.height_px,
        )
        scene.add_camera_with_trivial_rig(lens)
    image = pycolmap.Image(camera.name, np.ascontiguousarray(points), lens.camera_id, number)
    scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(camera.R), camera.t_m))


def _as_solved(scene: pycolmap.Reconstruction, number: int, camera: Camera, lens: pycolmap.Camera | None) -> Camera:
    image = scene.image(number)
    before_px = camera.K[0, 0] if lens is None else lens.params[0]
    zoom, pose = scene.camera(image.camera_id).params[0] / before_px, image.cam_from_world()
    return dataclasses.replace(zoomed(camera, zoom), R=pose.rotation.matrix(), t_m=np.array(pose.translation))


def zoomed(camera: Camera, zoom: float) -> Camera:
    """Return the camera with its focal length multiplied; its pose and principal point stay."""
    return dataclasses.replace(camera, K=camera.K * np.array([[zoom, zoom, 1], [1, zoom, 1], [1, 1, 1]]))


def align(cameras: Sequence[Camera], to: Sequence[Camera]) -> list[Camera]:
    """Return the rig after the similarity transform that brings it closest to another estimate of the same cameras.

    The world rotation is the chordal mean of R_to^T R (Hartley et al. 2013, Rotation Averaging, section 5); scale and
    translation are least squares on the camera centres.
    """
    turns = Rotation.from_matrix(np.stack([old.R.T @ new.R for new, old in zip(cameras, to, strict=True)]))
    world = turns.mean().as_matrix()
    centres = np.stack([camera.centre_m for camera in cameras]) @ world.T
    wanted = np.stack([camera.centre_m for camera in to])
    spread, wanted_spread = centres - centres.mean(0), wanted - wanted.mean(0)
    scale = float((spread * wanted_spread).sum() / (spread**2).sum())
    moved = scale * spread + wanted.mean(0)
    return [
        dataclasses.replace(camera, R=camera.R @ world.T, t_m=-camera.R @ world.T @ centre)
        for camera, centre in zip(cameras, moved, strict=True)
    ]

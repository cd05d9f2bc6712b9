"""Bundle adjustment of camera poses with the keypoints of the person as wand points (Ceres, through pycolmap)."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pycolmap

from hnerf.calibration.triangulation import reprojection_px, triangulate
from hnerf.capture.camera import Camera

ROUNDS = 3  # triangulate, adjust, and again with the better cameras
LOSS_SCALE_PX = 2.0  # about a detector's noise
MIN_OBSERVATIONS = 50  # with fewer, the cameras have drifted apart: there is nothing to adjust to
MAX_FRAMES = 100  # a hundred poses, evenly chosen, hold a camera firmly


def adjust(cameras: Sequence[Camera], keypoints: np.ndarray, free: Sequence[str]) -> list[Camera]:
    """Cameras with the poses of those named in `free` adjusted to keypoints (C, frames, 25, 3); intrinsics stay.

    Where two others are fixed, they alone place the points, and every keypoint of a free camera counts, far off
    as it may be. Where all are free, the rig is moved as a whole, and scaled, to the old cameras: the world stays.
    """
    chosen = np.unique(np.linspace(0, keypoints.shape[1] - 1, MAX_FRAMES).round().astype(int))
    flat = keypoints[:, chosen].reshape(len(cameras), -1, 3)
    moving = np.array([camera.name in free for camera in cameras])
    judges = ~moving if (~moving).sum() >= 2 else np.ones_like(moving)
    judged = flat.copy()
    judged[~judges, :, 2] = 0
    adjusted = list(cameras)
    for _ in range(ROUNDS):
        projections = np.stack([camera.projection for camera in adjusted])
        points_m, _, inliers = triangulate(projections, judged)
        residuals_px = reprojection_px(projections, points_m, flat)
        used = inliers | (~judges[:, None] & (flat[..., 2] > 0) & np.isfinite(residuals_px))
        if used.sum() < MIN_OBSERVATIONS:
            break
        loss_scale_px = max(LOSS_SCALE_PX, float(np.median(residuals_px[used])))
        adjusted = _bundle_adjust(adjusted, flat, points_m, used, free, loss_scale_px)
    return align(adjusted, cameras) if moving.all() else adjusted


def _bundle_adjust(
    cameras: Sequence[Camera],
    keypoints: np.ndarray,
    points_m: np.ndarray,
    used: np.ndarray,
    free: Sequence[str],
    loss_scale_px: float,
) -> list[Camera]:
    """One solve over the used observations (C, K): every (frame, joint) a point, one image per camera."""
    scene = pycolmap.Reconstruction()
    config = pycolmap.BundleAdjustmentConfig()
    for i, camera in enumerate(cameras, start=1):
        K = camera.K
        pinhole = {"model": "PINHOLE", "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}
        scene.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=i, width=camera.width_px, height=camera.height_px, **pinhole)
        )
        image = pycolmap.Image(camera.name, np.ascontiguousarray(keypoints[i - 1, :, :2]), i, i)
        scene.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(camera.R), camera.t_m))
        config.add_image(i)
        config.set_constant_cam_intrinsics(i)
        if camera.name not in free:
            config.set_constant_rig_from_world_pose(i)
    for k in np.flatnonzero(used.sum(0) >= 2):
        track = [pycolmap.TrackElement(int(c) + 1, int(k)) for c in np.flatnonzero(used[:, k])]
        scene.add_point3D(points_m[k], pycolmap.Track(track))
    if len(cameras) - len(free) < 2:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_scale_px
    pycolmap.create_default_ceres_bundle_adjuster(options, config, scene).solve()
    poses = [scene.image(i).cam_from_world() for i in range(1, len(cameras) + 1)]
    return [
        dataclasses.replace(camera, R=pose.rotation.matrix(), t_m=np.array(pose.translation))
        if camera.name in free
        else camera
        for camera, pose in zip(cameras, poses, strict=True)
    ]


def align(cameras: Sequence[Camera], to: Sequence[Camera]) -> list[Camera]:
    """The rig moved as a whole, turned and scaled, so that it lies nearest to another pose of the same cameras.

    World rotation: chordal mean of R_to^T R (Hartley et al. 2013, Rotation Averaging, section 5); scale and shift:
    least squares on the centres.
    """
    u, _, vt = np.linalg.svd(sum(old.R.T @ new.R for new, old in zip(cameras, to, strict=True)))
    world = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    centres = np.stack([camera.centre_m for camera in cameras]) @ world.T
    wanted = np.stack([camera.centre_m for camera in to])
    spread, wanted_spread = centres - centres.mean(0), wanted - wanted.mean(0)
    scale = float((spread * wanted_spread).sum() / (spread**2).sum())
    moved = scale * spread + wanted.mean(0)
    return [
        dataclasses.replace(camera, R=camera.R @ world.T, t_m=-camera.R @ world.T @ centre)
        for camera, centre in zip(cameras, moved, strict=True)
    ]

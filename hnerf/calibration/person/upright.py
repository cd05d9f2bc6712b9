"""Up, ground and scale of a rig calibrated from the person alone: from the feet, the head and the person's height."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from hnerf.calibration.diagnosis import body_height_m
from hnerf.capture.body_25 import ANKLES, LEFT_FOOT, RIGHT_FOOT, Body25
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera

MEAN_STATURE_M, STATURE_SD_M = 1.65, 0.09  # of adults: NCD-RisC 2016 has means of 1.71 (men) and 1.59 m (women)
CHAIN_SD = 0.03  # relative error of a stature from limb lengths, due to how a detector defines joints
FEET = ((Body25.R_ANKLE, *RIGHT_FOOT), (Body25.L_ANKLE, *LEFT_FOOT))
LEAN_SD = np.tan(np.deg2rad(6.0))  # of the mean direction from ankles to neck: people lean as they walk and reach
ROLL_SD = np.deg2rad(3.0)  # of a camera about its line of sight: people hold and mount cameras level, or on edge
CONTACT_SD_M = 0.02  # of a standing foot's lowest keypoint above the ground
STEP_S = 1 / 3  # duration of a step: its frames all say the same about the ground
ROUNDS = 30  # of iteratively re-weighted least squares
FIRST_SCALE = 4.0  # times the standard deviations, from which the Cauchy scale shrinks to 1


def scale_to(cameras: Sequence[Camera], points: np.ndarray, height_m: float) -> tuple[list[Camera], np.ndarray]:
    """Return the rig and its points (frames, 25, 3) scaled so that the person has this height. Raises InputError if
    legs, trunk or nose were never seen by two cameras."""
    found = body_height_m(points)
    if not np.isfinite(found):
        raise InputError(
            "legs, trunk or nose are never seen by two cameras at once, so the scale is unknown; film the whole person"
        )
    scale = height_m / found
    return [dataclasses.replace(camera, t_m=scale * camera.t_m) for camera in cameras], scale * points


def stand_on_ground(cameras: Sequence[Camera], points_m: np.ndarray, frame_s: float) -> tuple[list[Camera], float]:
    """Return the rig in a world with Z up, the ground at 0 below the middle of the person's path, and the first camera
    towards -Y; and the standard error of up in degrees.

    points_m (frames, 25, 3): of the person; frame_s: seconds between successive frames. Raises InputError if ankles and
    neck are never seen.
    """
    world, up_sd = _upright(cameras, points_m, frame_s)
    turned_m = points_m @ world.T
    feet_m = _lowest_of_feet(turned_m)
    ground_m = float(np.median(feet_m[:, 2])) if len(feet_m) else float(np.nanmin(turned_m[..., 2]))
    origin_m = np.array([*np.nanmedian(turned_m.reshape(-1, 3)[:, :2], axis=0), ground_m])
    first = world @ cameras[0].centre_m - origin_m
    heading = Rotation.from_euler("z", -np.pi / 2 - np.arctan2(first[1], first[0])).as_matrix()
    world, origin_m = heading @ world, heading @ origin_m
    turned = [
        dataclasses.replace(camera, R=camera.R @ world.T, t_m=camera.t_m + camera.R @ world.T @ origin_m)
        for camera in cameras
    ]
    return turned, float(np.rad2deg(up_sd))


def _upright(cameras: Sequence[Camera], points_m: np.ndarray, frame_s: float) -> tuple[np.ndarray, float]:
    """Return the rotation (3, 3) to a world with Z up, and the standard error of up in radians.

    Three cues determine up. It is the normal (-a, -b, 1) of the ground z = a x + b y + c on which the lower keypoints
    of standing feet lie, as far as their path is wide enough; it is the mean direction from ankles to neck; and it is
    perpendicular to the x axes of level cameras (Brown and Lowe 2007, section 5), or to the y axes of cameras on edge.
    Each cue has Cauchy weights, since a foot may swing, a person may lean and a camera may be tilted.
    """
    world = _rotation(_body_direction(points_m))
    for scale in np.geomspace(FIRST_SCALE, 1, ROUNDS):
        feet_m = _lowest_of_feet(points_m @ world.T)
        body = world @ _body_direction(points_m)
        sideways = np.stack([min(camera.R[:2] @ world.T, key=lambda axis: abs(axis[2])) for camera in cameras])
        height_m = np.median(feet_m[:, 2]) if len(feet_m) else 0.0
        middle_m = feet_m.mean(0) if len(feet_m) else np.zeros(3)
        # Unknowns: the slopes a and b, and c - height_m. Each row is divided by its standard deviation.
        rows = [
            np.column_stack([feet_m[:, :2] - middle_m[:2], np.ones(len(feet_m)), feet_m[:, 2] - height_m])
            / CONTACT_SD_M,
            np.array([[-1, 0, 0, body[0] / body[2]], [0, -1, 0, body[1] / body[2]]]) / LEAN_SD,
            np.column_stack([sideways[:, :2], np.zeros(len(sideways)), sideways[:, 2]]) / ROLL_SD,
        ]
        counts = [0.5 * min(1.0, frame_s / STEP_S), 1.0, 1.0]  # the frames of one step of each foot count as one
        A = np.concatenate([np.sqrt(count) * part for part, count in zip(rows, counts, strict=True)])
        off = np.concatenate([part[:, 3] for part in rows])
        # The two residuals of the body are those of one direction, so they get one weight.
        off[len(feet_m) : len(feet_m) + 2] = np.linalg.norm(off[len(feet_m) : len(feet_m) + 2])
        weights = 1 / (1 + (off / scale) ** 2)
        normal = (A[:, :3] * weights[:, None]).T @ A[:, :3] + 1e-9 * np.eye(3)
        a, b, _ = np.linalg.solve(normal, (A[:, :3] * weights[:, None]).T @ A[:, 3])
        world = _rotation(np.array([-a, -b, 1.0])) @ world
    contradiction = float(np.sqrt(np.mean(off[len(feet_m) :] ** 2)))  # by body and cameras: leaning, tilted cameras
    return world, max(1.0, contradiction) * float(np.sqrt(np.linalg.inv(normal)[:2, :2].diagonal().max()))


def _body_direction(points_m: np.ndarray) -> np.ndarray:
    """Return the median direction (3,), of length 1, from the ankles to the neck."""
    body_m = points_m[:, Body25.NECK] - points_m[:, ANKLES].mean(1)
    body_m = body_m[np.isfinite(body_m).all(-1)]
    if not len(body_m):
        raise InputError(
            "ankles and neck are never seen by two cameras at once, so the vertical is unknown; film the whole person"
        )
    middle = np.median(body_m, axis=0)
    return middle / np.linalg.norm(middle)


def _rotation(up: np.ndarray) -> np.ndarray:
    """Return the smallest rotation (3, 3) that maps a direction to +Z."""
    return np.asarray(Rotation.align_vectors([[0.0, 0, 1]], up[None])[0].as_matrix())


def _lowest_of_feet(points_m: np.ndarray) -> np.ndarray:
    """Return the lowest keypoint (n, 3) of each foot in each frame that shows one, Z being up."""
    lowest = []
    for joints in FEET:
        foot_m = points_m[:, joints]
        height_m = np.where(np.isfinite(foot_m).all(-1), foot_m[..., 2], np.inf)
        shown = np.isfinite(height_m).any(1)
        lowest.append(foot_m[shown, height_m[shown].argmin(1)])
    return np.concatenate(lowest)

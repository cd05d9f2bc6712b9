"""A camera as calibrated, with its lens distortion: the content of a calibration file."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hnerf.capture.safe_io import check_camera_name, check_image_size
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera

MIN_FOCAL_PX = 1.0  # a smaller focal length is an error of units
MAX_SKEW_PX = 0.1  # of a camera with distortion, which OpenCV undistorts as if there were no skew
MAX_NUMBER = 1e9  # largest number in a calibration; beyond it, later arithmetic overflows
# OpenCV's default of 5 iterations is off by pixels.
UNDISTORTED = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-3)
FISHEYE_UNDISTORTED = (*UNDISTORTED[:2], 1e-9)  # radians
MAX_OFF_PX = 1.0  # between a recorded pixel and the projection of the ray that was found for it
MAX_TANGENT = 5.67  # of a fisheye's ray to the axis, 80 degrees: there, undistortion multiplies errors by 33


@dataclass(frozen=True)
class Lens:
    """A calibrated camera with lens distortion: K (3, 3) pixels; distortion (4,), (5,) or (8,), OpenCV's k1 k2 p1 p2
    [k3 [k4 k5 k6]]; R (3, 3), t_m (3,) world to camera.

    `size_px` is the (width, height) that was calibrated, None if the file does not say; `estimated`: whether
    K comes from an angle or from the person, not from a file of intrinsics; `fisheye`: whether distortion (4,) is k1 to
    k4 of OpenCV's fisheye model, which images a ray at the angle a to the axis at the radius a (1 + k1 a^2 + k2 a^4 +
    ...), in units of the focal length (Kannala and Brandt 2006).
    """

    name: str
    K: np.ndarray
    distortion: np.ndarray
    R: np.ndarray
    t_m: np.ndarray
    size_px: tuple[int, int] | None
    estimated: bool = False
    fisheye: bool = False

    @property
    def distorts(self) -> bool:
        """Return whether recorded images differ from those of a linear camera."""
        return self.fisheye or bool(np.any(self.distortion))


def pinhole(camera: Camera) -> Lens:
    """Return a camera of undistorted images as a lens without distortion."""
    return Lens(camera.name, camera.K, np.zeros(5), camera.R, camera.t_m, camera.size_px)


def undistort_points(points_px: np.ndarray, lens: Lens) -> np.ndarray:
    """Map pixels (..., 2) of a recorded image to those of the pinhole camera with the same K; NaN stays NaN. Pixels
    outside the lens's valid image area, for which OpenCV returns arbitrary pixels, become NaN, and so do those of a
    fisheye's rays beyond MAX_TANGENT."""
    if points_px.size == 0:  # for which OpenCV returns None
        return points_px
    flat = np.ascontiguousarray(points_px.reshape(-1, 1, 2))
    K, distortion = lens.K, lens.distortion
    if lens.fisheye:
        straight = cv2.fisheye.undistortPoints(flat, K, distortion, P=K, criteria=FISHEYE_UNDISTORTED)[:, 0]
        tangents = np.linalg.norm((straight - K[:2, 2]) / K.diagonal()[:2], axis=-1)
        straight[tangents > MAX_TANGENT] = np.nan
    else:
        straight = cv2.undistortPoints(flat, K, distortion, P=K, criteria=UNDISTORTED)[:, 0]
    pictured = distort_points(straight, lens)
    straight[~(np.linalg.norm(pictured - flat[:, 0], axis=-1) < MAX_OFF_PX)] = np.nan
    return straight.reshape(points_px.shape)


def distort_points(points_px: np.ndarray, lens: Lens) -> np.ndarray:
    """Map pixels (N, 2) of the pinhole camera with this lens's K to those of the recorded image."""
    rays = np.concatenate([points_px, np.ones((len(points_px), 1))], 1) @ np.linalg.inv(lens.K).T
    project = cv2.fisheye.projectPoints if lens.fisheye else cv2.projectPoints
    return project(rays[:, None], np.zeros(3), np.zeros(3), lens.K, lens.distortion)[0][:, 0]


def undistort_keypoints(keypoints: np.ndarray, lens: Lens) -> np.ndarray:
    """Map keypoints (..., 3) x_px, y_px, confidence as `undistort_points` does; 0 outside the lens's valid image
    area."""
    straight = undistort_points(keypoints[..., :2], lens)
    pictured = np.isfinite(straight).all(-1, keepdims=True)
    return np.where(pictured, np.concatenate([straight, keypoints[..., 2:]], -1), 0.0)


def known_size(lens: Lens) -> tuple[int, int]:
    """Return the (width, height) that a file to be written must state. Raises InputError if it is not known."""
    if lens.size_px is None:
        raise InputError(f"intri.yml: camera {lens.name} has no size; add W_{lens.name} and H_{lens.name}")
    return lens.size_px


def by_name(lenses: Iterable[Lens], source: Path) -> dict[str, Lens]:
    """Return lenses by name. Raises InputError naming `source` if two have the same name."""
    found: dict[str, Lens] = {}
    for lens in lenses:
        if lens.name in found:
            raise InputError(f"{source}: two cameras are called {lens.name}; rename one of them, and its footage")
        found[lens.name] = lens
    return found


def checked_lens(
    source: Path,
    name: object,
    K: np.ndarray,
    distortion: np.ndarray,
    R: np.ndarray,
    t_m: np.ndarray,
    size_px: tuple[float, float] | None,
    estimated: bool = False,
    extrinsics: Path | None = None,
    fisheye: bool = False,
) -> Lens:
    """Return a Lens from numbers of any shape. Raises InputError naming file and camera if they do not describe a
    camera.

    source: the file; extrinsics: that of R and t_m, if they are in another one. R: a matrix or a rotation vector
    (Rodrigues).
    """
    camera, extrinsics = check_camera_name(name, source), extrinsics or source
    for file, label, value, sizes in (
        (source, "K", K, (9,)),
        (source, "distortion", distortion, (4,) if fisheye else (4, 5, 8)),
        (extrinsics, "R", R, (3, 9)),
        (extrinsics, "T", t_m, (3,)),
    ):
        if value.size not in sizes:
            right = " or ".join(map(str, sizes))
            raise InputError(f"{file}: camera {camera}: {label} has {value.size} numbers, not {right}; calibrate again")
        if not np.isfinite(value).all():
            raise InputError(f"{file}: camera {camera}: {label} holds a NaN or infinity; calibrate again")
        if np.abs(value).max() > MAX_NUMBER:
            raise InputError(f"{file}: camera {camera}: {label} holds {np.abs(value).max():.3g}; calibrate again")
    K, R = K.reshape(3, 3), cv2.Rodrigues(R.ravel())[0] if R.size == 3 else R.reshape(3, 3)
    if K[0, 0] < MIN_FOCAL_PX or K[1, 1] < MIN_FOCAL_PX or K[1, 0] != 0 or K[2].tolist() != [0, 0, 1]:
        raise InputError(f"{source}: camera {camera}: K is not a matrix of intrinsics in pixels; calibrate again")
    if abs(K[0, 1]) > MAX_SKEW_PX and (fisheye or np.any(distortion)):
        raise InputError(
            f"{source}: camera {camera}: has both skew and lens distortion, which cannot be undistorted together; "
            "calibrate again without skew"
        )
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise InputError(f"{extrinsics}: camera {camera}: R is not a rotation; calibrate again")
    size = check_image_size(source, *size_px) if size_px else None
    return Lens(camera, K, distortion.ravel(), R, t_m.ravel(), size, estimated, fisheye)

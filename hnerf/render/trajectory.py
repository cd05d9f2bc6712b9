"""Camera trajectories: a circle around the person, or a smooth path through given cameras."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

from hnerf.capture.ingest import recognise
from hnerf.capture.lens import Lens, checked_lens
from hnerf.capture.manifest import read_manifest
from hnerf.capture.safe_io import read_json
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera, look_at


def orbit(
    cameras: Sequence[Camera],
    target_m: np.ndarray,
    count: int,
    up: str,
    radius_m: float | None = None,
    height_m: float | None = None,
) -> list[Camera]:
    """Return `count` cameras on a full horizontal circle, counter-clockwise from above, that look at `target_m` (3,) in
    the world.

    The first has the intrinsics and the bearing of cameras[0]. radius_m: horizontal distance from the target; height_m:
    above the target, along the world's axis `up`; each defaults to the mean over `cameras`. Raises InputError if the
    radius is not positive.
    """
    vertical = "xyz".index(up)
    axis = np.eye(3)[vertical]
    offsets_m = np.stack([camera.centre_m for camera in cameras]) - target_m
    level_m = offsets_m * (1 - axis)
    radius_m = float(np.linalg.norm(level_m, axis=1).mean()) if radius_m is None else radius_m
    height_m = float(offsets_m[:, vertical].mean()) if height_m is None else height_m
    length_m = np.linalg.norm(level_m[0])
    if not (radius_m > 0 and length_m > 0 and np.isfinite([radius_m, height_m]).all()):
        raise InputError(f"orbit of radius {radius_m:g} m, height {height_m:g} m: not a circle; give a radius above 0")
    ahead = level_m[0] / length_m
    aside = np.cross(axis, ahead)
    turns = 2 * np.pi * np.arange(count) / count
    bearings = np.cos(turns)[:, None] * ahead + np.sin(turns)[:, None] * aside
    return [look_at(cameras[0], target_m + radius_m * b + height_m * axis, target_m, axis) for b in bearings]


def interpolate_cameras(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """Return `count` cameras from the first to the last through all others, at equal steps of the camera index.

    Centres run on a cubic spline, rotations on one with continuous angular acceleration (scipy's RotationSpline), K
    changes linearly. All images have the first camera's size.
    """
    if len(cameras) == 1:
        return list(cameras) * count
    keys, steps = np.arange(len(cameras)), np.linspace(0, len(cameras) - 1, count)
    centres_m = CubicSpline(keys, np.stack([camera.centre_m for camera in cameras]))(steps)
    rotations = RotationSpline(keys, Rotation.from_matrix(np.stack([camera.R for camera in cameras])))(steps)
    lenses = make_interp_spline(keys, np.stack([camera.K for camera in cameras]), k=1)(steps)
    return [
        dataclasses.replace(cameras[0], K=K, R=R, t_m=-R @ centre_m)
        for K, R, centre_m in zip(lenses, rotations.as_matrix(), centres_m, strict=True)
    ]


def read_camera_path(path: Path, size_px: tuple[int, int]) -> list[Camera]:
    """Read the cameras of a path, in the file's order: a JSON list of {"K", "R", "t_m", "size_px"} (conventions of
    hnerf.geometry.camera), or a folder in any layout that captures are read from.

    size_px: (width, height) of images if the file does not say. Lens distortion is ignored. Raises InputError if there
    are no cameras, or cameras of several image sizes.
    """
    if path.is_dir():
        lenses, metres_per_unit = list(recognise(path).lenses().values()), read_manifest(path).metres_per_unit
    else:
        lenses, metres_per_unit = _json_lenses(path), 1.0
    cameras = [
        Camera(lens.name, lens.K, lens.R, metres_per_unit * lens.t_m, *(lens.size_px or size_px)) for lens in lenses
    ]
    sizes = {camera.size_px for camera in cameras}
    if len(sizes) != 1:
        raise InputError(
            f"{path}: has cameras of {len(sizes)} image sizes; a path needs one or more cameras, all of one size"
        )
    return cameras


def _json_lenses(path: Path) -> list[Lens]:
    entries = read_json(path)
    try:
        return [
            checked_lens(
                source=path,
                name=str(k),
                K=np.array(entry["K"], np.float64),
                distortion=np.zeros(4),
                R=np.array(entry["R"], np.float64),
                t_m=np.array(entry["t_m"], np.float64),
                size_px=(float(entry["size_px"][0]), float(entry["size_px"][1])),
            )
            for k, entry in enumerate(entries)
        ]
    except (KeyError, IndexError, OverflowError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: not a list of cameras ({error}); each needs K (3x3), R (3x3), t_m (3), size_px (2)"
        ) from None

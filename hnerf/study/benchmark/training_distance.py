"""Distance of held-out images from the training data, in view angle and in pose."""

from collections.abc import Iterable

import numpy as np

from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import rotation_from_axis_angle
from hnerf.geometry.camera import Camera


def view_angle_deg(camera: Camera, others: Iterable[Camera], middle_m: np.ndarray) -> float:
    """Return the angle, seen from a world point (3,), between a camera and the one of `others` that is nearest in
    angle."""
    towards = _unit(camera.centre_m - middle_m)
    cosines = [towards @ _unit(other.centre_m - middle_m) for other in others]
    return float(np.rad2deg(np.arccos(np.clip(max(cosines), -1, 1))))


def pose_distances_deg(body: BodyFit, frames: Iterable[int], others: Iterable[int]) -> dict[int, float]:
    """Return, for each frame, the distance of its pose from the nearest pose of the other frames: the mean angle of the
    relative rotations of free joints. Walking, or turning the whole body, does not count."""
    turns = rotation_from_axis_angle(body.theta[:, body.rig.free].double()).cpu()
    known = turns[[body.index(frame) for frame in others]]
    # |A - B| of two rotations is sqrt(8) times the sine of half the angle between them.
    halves = {f: (known - turns[body.index(f)]).flatten(2).norm(dim=-1) / 8**0.5 for f in frames}
    angles_deg = {f: (2 * sine.clamp(max=1).asin()).rad2deg() for f, sine in halves.items()}
    return {f: float(angle_deg.sum(1).min()) / max(1, turns.shape[1]) for f, angle_deg in angles_deg.items()}


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)

"""How far a held-out image is from what was trained on."""

from collections.abc import Iterable

import numpy as np
import torch

from hnerf.body.fit_result import BodyFit
from hnerf.body.rig import pose_vertices
from hnerf.capture.camera import Camera


def view_angle_deg(camera: Camera, others: Iterable[Camera], middle_m: np.ndarray) -> float:
    """Angle at a point (3,) in the world between a camera and the nearest in angle of others."""
    towards = _unit(camera.centre_m - middle_m)
    cosines = [towards @ _unit(other.centre_m - middle_m) for other in others]
    return float(np.rad2deg(np.arccos(np.clip(max(cosines), -1, 1))))


def pose_distances_mm(body: BodyFit, frames: Iterable[int], others: Iterable[int]) -> dict[int, float]:
    """For each frame, how far the surface of its pose is from that of the nearest of other frames: mean distance of
    corresponding vertices in the body frame, so that walking or turning as a whole is no distance."""
    still = torch.eye(4, device=body.theta.device).expand(len(body.frames), 4, 4)
    vertices_m = pose_vertices(body.rig, body.theta, still).cpu()
    known = vertices_m[[body.index(frame) for frame in others]]
    apart_m = {f: (known - vertices_m[body.index(f)]).norm(dim=-1).mean(1).min() for f in frames}
    return {frame: 1e3 * float(distance_m) for frame, distance_m in apart_m.items()}


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)

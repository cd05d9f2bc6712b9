"""Exposure differences between cameras: gains per camera and channel, from what pairs of cameras see of the same body
points."""

from itertools import combinations

import numpy as np

from hnerf.avatar.avatar import Gains
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.evenly_spaced import evenly_spaced
from hnerf.geometry.camera import Camera
from hnerf.geometry.mesh_queries import Surface
from hnerf.training.auto_settings import Decision

MAX_FRAMES = 8  # number of frames to compare, evenly spaced
MIN_FACING_COSINE = 0.4  # between a vertex's normal and its direction to the camera
MIN_LEVEL, MAX_LEVEL = 15, 245  # of 255; levels outside are noise or clipped
MIN_SHARED_VERTICES = 100  # by two cameras, for their ratio to count
MAJORITY = 0.5  # share of the cameras
MIN_LOG_GAIN = 0.1  # shading and small errors of the fit leave 0.03 for cameras exposed alike


def camera_gains(capture: Capture, masks: Masks, body: BodyFit) -> tuple[Gains, Decision]:
    """Return the gains (R, G, B) of the training cameras and the reason (with their means over channels); no gains if
    the cameras are exposed alike.

    If most cameras agree, their gain is 1; otherwise the geometric mean of all gains is 1. A camera that shares no
    points with another takes the median gain. Cameras a and b show the same body points brighter or darker by a median
    ratio r_ab over points and frames; log g_b - log g_a = log r_ab is solved for all pairs by least squares, weighted
    by their numbers of points.
    """
    names = capture.train_cameras
    ratios: dict[tuple[int, int], list[np.ndarray]] = {pair: [] for pair in combinations(range(len(names)), 2)}
    vertices_m, faces = body.vertices_m().numpy(), body.rig.faces.numpy()
    for frame in evenly_spaced(capture.train_frames, MAX_FRAMES) if ratios else ():
        surface = Surface.of(vertices_m[body.index(frame)], faces)
        levels = [_vertex_colours(capture, masks, surface, name, frame) for name in names]
        for (a, b), found in ratios.items():
            both = np.isfinite(levels[a] + levels[b]).all(1)
            found.append(np.log(levels[b][both] / levels[a][both]))
    pairs = {pair: np.concatenate(found) for pair, found in ratios.items()}
    usable = {pair: found for pair, found in pairs.items() if len(found) >= MIN_SHARED_VERTICES}
    logs = solve_gains(len(names), usable)
    known = np.isin(np.arange(len(names)), list(usable)) | (not usable)
    usual = np.median(logs[known], 0)
    logs[~known] = usual
    if (np.abs(logs - usual)[known].max(1) < MIN_LOG_GAIN).mean() > MAJORITY:
        logs = logs - usual
    furthest = float(np.abs(logs).max())
    message = (
        f"on the same points of the body, cameras differ from the usual exposure by {np.expm1(furthest):.0%} at most"
    )
    if furthest < MIN_LOG_GAIN:
        return {}, Decision(1.0, f"{message}: shading can explain it" if logs.any() else "no two cameras to compare")
    gains = {name: (float(r), float(g), float(b)) for name, (r, g, b) in zip(names, np.exp(logs), strict=True)}
    return gains, Decision(tuple(round(float(np.mean(g)), 3) for g in gains.values()), message)


def solve_gains(cameras: int, pairs: dict[tuple[int, int], np.ndarray]) -> np.ndarray:
    """Return logarithms of gains (C, 3), with mean 0 over connected cameras, from the logarithms of ratios (n, 3) of
    each pair."""
    rows, wanted = np.zeros((len(pairs), cameras)), np.zeros((len(pairs), 3))
    for k, ((a, b), found) in enumerate(pairs.items()):
        weight = np.sqrt(len(found))
        rows[k, [a, b]], wanted[k] = (-weight, weight), weight * np.median(found, 0)
    return np.linalg.lstsq(rows, wanted, rcond=None)[0] if pairs else np.zeros((cameras, 3))


def _vertex_colours(capture: Capture, masks: Masks, surface: Surface, name: str, frame: int) -> np.ndarray:
    """Return a camera's colours at the body's vertices, (V, 3) of 255; NaN where a vertex is hidden or its colour
    unusable."""
    levels = np.full(surface.mesh.vertices.shape, np.nan)
    if (name, frame) not in masks:
        return levels
    camera = capture.cameras[name]
    seen, xy = _visible_vertices(camera, surface)
    x, y = xy.T
    levels[seen] = capture.image(name, frame)[y, x]
    valid = masks.get(name, frame)[y, x] & (levels[seen] > MIN_LEVEL).all(1) & (levels[seen] < MAX_LEVEL).all(1)
    levels[np.flatnonzero(seen)[~valid]] = np.nan
    return levels


def _visible_vertices(camera: Camera, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Return which vertices face the camera unoccluded, (V,) bool, and their pixels (n, 2)."""
    mesh = surface.mesh
    away = camera.centre_m - mesh.vertices
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    xy, depth_m = camera.project(mesh.vertices)
    xy = np.round(xy)
    inside = camera.holds(xy) & (depth_m > 0)
    seen = inside & ((away * mesh.vertex_normals).sum(1) > MIN_FACING_COSINE)
    hits = surface.cast(camera.centre_m, -away[seen])
    met = (mesh.faces[hits.face] == np.flatnonzero(seen)[:, None]).any(1)
    seen[np.flatnonzero(seen)[~met]] = False
    return seen, xy[seen].astype(int)

"""Colours of the clothes, the face and the room."""

import numpy as np

from hnerf.capture.body_25 import Body25

ROOM_HALF_SIDE_M = 4.2
ROOM_HEIGHT_M = 3.2
FACE = (Body25.R_EYE, Body25.L_EYE, Body25.NOSE)


def person_colour(face_m: np.ndarray, rest_m: np.ndarray, depths_m: np.ndarray) -> np.ndarray:
    """Return albedo (N, 3) at points of the unclothed rest body (N, 3), given each point's depth in each garment (N,
    5).

    face_m (3, 3): the rest body's keypoints FACE.
    """
    deepest, colour = depths_m.argmax(1), np.empty_like(rest_m)
    painters = (lambda p, _: _skin(face_m, p), _shirt, _trousers, _shoes, _hair)  # in the order of depths_m
    for garment, paint in enumerate(painters):
        here = deepest == garment
        colour[here] = paint(rest_m[here], depths_m[here, garment])
    return colour


def _skin(face_m: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the colours of skin, lips, eyes and brows."""
    right_eye, left_eye, nose = face_m
    blotches = 1 + 0.03 * np.sin(31 * p[:, 0] + 17 * p[:, 1] + 23 * p[:, 2])
    colour = blotches[:, None] * [0.80, 0.60, 0.49]
    over = np.array([0, 0, 0.026])
    lips = _ellipse(p, nose + np.array([0, 0.015, -0.050]), (0.026, 0.009))
    colour[lips] = (0.66, 0.33, 0.30)
    for eye in (right_eye, left_eye):
        colour[_ellipse(p, eye + over, (0.022, 0.006))] = (0.20, 0.13, 0.10)
        colour[_ellipse(p, eye, (0.016, 0.008))] = (0.93, 0.92, 0.90)
        colour[_ellipse(p, eye, (0.007, 0.008))] = (0.15, 0.10, 0.08)
    return colour


def _shirt(p: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """Paint a check of three colours, a lighter hem, a round emblem on the chest and a bar on the back."""
    x, y, z = p.T
    colour = np.tile([0.16, 0.46, 0.52], (len(p), 1))
    colour[(np.mod(z, 0.11) < 0.035) | (np.mod(x + 0.0175, 0.11) < 0.035)] = (0.93, 0.87, 0.70)
    colour[(np.mod(z, 0.11) < 0.035) & (np.mod(x + 0.0175, 0.11) < 0.035)] = (0.83, 0.35, 0.20)
    radius_m = np.hypot(x, z - 0.46)
    colour[(y < 0) & (radius_m < 0.085)] = (0.95, 0.75, 0.15)
    colour[(y < 0) & (radius_m < 0.050)] = (0.62, 0.10, 0.16)
    colour[(y > 0) & (np.abs(x) < 0.03) & (np.abs(z - 0.46) < 0.10)] = (0.95, 0.75, 0.15)
    colour[depth_m < 0.018] = (0.93, 0.87, 0.70)
    return colour


def _trousers(p: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """Paint denim, faded at the thighs, with a seam along the outside and a patch on one knee."""
    x, y, z = p.T
    fade = np.exp(-(((z + 0.10) / 0.16) ** 2)) * (y < 0)
    weave = 0.04 * np.sin(47 * x + 3 * np.sin(41 * z)) * np.sin(53 * z + 29 * y)
    colour = np.array([0.20, 0.27, 0.46]) + (0.16 * fade + weave)[:, None]
    outside = np.abs(x) - 0.165 - 0.05 * np.clip(-z, 0, 1)
    colour[(np.abs(y + 0.02) < 0.012) & (outside > 0)] = (0.80, 0.58, 0.25)
    colour[(x > 0) & (y < 0) & (np.abs(z + 0.28) < 0.06) & (np.abs(x - 0.15) < 0.05)] = (0.55, 0.20, 0.22)
    colour[(depth_m < 0.03) & (z < -0.4)] *= 1.35
    return colour


def _shoes(p: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """Paint shoes with light soles."""
    colour = np.tile([0.70, 0.16, 0.14], (len(p), 1))
    colour[depth_m > 0.085] = (0.92, 0.91, 0.88)  # soles
    return colour


def _hair(p: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """Paint strands of hair."""
    strands = 0.5 + 0.5 * np.sin(95 * np.arctan2(p[:, 0], -p[:, 1] - 0.05) + 6 * np.sin(40 * p[:, 2]))
    return np.array([0.20, 0.12, 0.07]) + strands[:, None] * [0.20, 0.13, 0.07]


def _ellipse(p: np.ndarray, centre: np.ndarray, radii_m: tuple[float, float]) -> np.ndarray:
    """Return whether points of the face lie in an upright ellipse seen from the front."""
    across, up = (p[:, 0] - centre[0]) / radii_m[0], (p[:, 2] - centre[2]) / radii_m[1]
    return (across**2 + up**2 < 1) & (np.abs(p[:, 1] - centre[1]) < 0.05)


def room_colour(origin_m: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lit colours (N, 3) and hit points (N, 3) of rays (N, 3) from inside the room."""
    low = np.array([-ROOM_HALF_SIDE_M, -ROOM_HALF_SIDE_M, 0.0])
    high = np.array([ROOM_HALF_SIDE_M, ROOM_HALF_SIDE_M, ROOM_HEIGHT_M])
    with np.errstate(divide="ignore"):
        exits = np.abs((np.where(directions > 0, high, low) - origin_m) / directions)  # infinite along a wall
    axis = exits.argmin(1)
    hit = origin_m + exits.min(1)[:, None] * directions
    level, colour = axis == 2, np.empty_like(hit)
    colour[level], colour[~level] = _floor_or_ceiling(hit[level]), _wall(hit[~level], axis[~level], directions[~level])
    nearest_corner_m = np.sort(np.minimum(hit - low, high - hit), axis=1)[:, 1]
    return colour * (1 - 0.35 * np.exp(-nearest_corner_m / 0.3))[:, None], hit


def _floor_or_ceiling(hit: np.ndarray) -> np.ndarray:
    """Paint planks of two browns with dark joints, and a white ceiling."""
    x, y, z = hit.T
    plank = np.floor(y / 0.18)
    shade = np.mod(np.sin(plank * 12.9898 + np.floor(x / 1.4 + 0.37 * plank) * 78.233) * 43758.5453, 1)
    colour = np.array([0.52, 0.38, 0.26]) * (0.8 + 0.4 * shade + 0.05 * np.sin(9 * x + 60 * y))[:, None]
    colour[(np.mod(y, 0.18) < 0.012) | (np.mod(x / 1.4 + 0.37 * plank, 1) < 0.008)] *= 0.55
    return np.where((z > 1)[:, None], [0.85, 0.85, 0.83], colour)


def _wall(hit: np.ndarray, axis: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Paint four walls, each with its own tint, a darker wainscot, a rail, wide stripes and one framed picture."""
    across, z = np.where(axis == 0, hit[:, 1], hit[:, 0]), hit[:, 2]
    facing = np.take_along_axis(directions, np.minimum(axis, 1)[:, None], 1)[:, 0] > 0
    tints = np.array([[0.74, 0.70, 0.60], [0.62, 0.70, 0.66], [0.72, 0.64, 0.62], [0.62, 0.66, 0.74]])
    colour = tints[2 * np.minimum(axis, 1) + facing] * (0.96 + 0.06 * (np.mod(across, 0.5) < 0.25))[:, None]
    colour[z < 0.9] *= 0.75
    colour[np.abs(z - 0.9) < 0.03] = (0.45, 0.36, 0.28)
    colour[z < 0.1] = (0.40, 0.32, 0.25)
    picture = np.maximum(np.abs(across - 0.9) / 0.55, np.abs(z - 1.75) / 0.4)
    bands = 0.5 + 0.5 * np.sin(np.stack([7 * across, 9 * z + 2, 8 * (across + z)], -1))
    colour = np.where((picture < 1)[:, None], 0.25 + 0.6 * bands, colour)
    colour[(picture >= 0.9) & (picture < 1)] = (0.22, 0.17, 0.14)
    return colour

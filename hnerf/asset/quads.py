"""Quads of a mesh that is stored as triangles, for formats that support polygons."""

import numpy as np


def polygon_corners(faces: np.ndarray) -> np.ndarray:
    """Return the polygons of triangles (F, 3), as rows of indices into `faces.ravel()`: quads (F / 2, 4) if every two
    successive triangles are the halves of one, else the triangles themselves.

    A quad begins on its diagonal, so that a fan from its first corner gives the same triangles.
    """
    corners = np.arange(faces.size).reshape(faces.shape)
    if len(faces) % 2:
        return corners
    first, second = faces[0::2], faces[1::2]
    shared = (first[:, :, None] == second[:, None, :]).any(2)
    foreign = ~(second[:, :, None] == first[:, None, :]).any(2)
    if not ((shared.sum(1) == 2) & (foreign.sum(1) == 1)).all():
        return corners
    rows, tip = np.arange(len(first)), (~shared).argmax(1)
    if not (first[rows, (tip + 1) % 3] == second[rows, (foreign.argmax(1) + 2) % 3]).all():  # with the same orientation
        return corners
    own = [corners[0::2][rows, (tip + k) % 3] for k in (1, 2, 0)]
    return np.stack([own[0], corners[1::2][rows, foreign.argmax(1)], own[1], own[2]], 1)

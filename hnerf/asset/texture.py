"""Texture coordinates, texels, and the image made of their colours."""

import ctypes
from dataclasses import dataclass

import cv2
import numpy as np
import xatlas
from scipy.ndimage import distance_transform_edt

from hnerf.geometry.rays import cast, mesh_on_cpu

CHART_PADDING_PX = 4
SUBPIXEL_BITS = 8
ALL = slice(None)


@dataclass(frozen=True)
class UvLayout:
    """Texture coordinates of a mesh. uvs (U, 2) float32 in [0, 1], v up; face_uvs (F, 3) long: rows of uvs for the
    corners of each face."""

    uvs: np.ndarray
    face_uvs: np.ndarray


@dataclass(frozen=True)
class Texels:
    """The covered texels of a texture: row, column (N,) from the image's top left, face (N,), barycentric (N, 3)."""

    row: np.ndarray
    column: np.ndarray
    face: np.ndarray
    barycentric: np.ndarray

    def interpolate(self, per_vertex: np.ndarray, faces: np.ndarray, index: np.ndarray | slice = ALL) -> np.ndarray:
        """Interpolate vertex values (V, C) on faces (F, 3) at the texels of an index, (M, C)."""
        corners, share = faces.take(self.face[index], 0).T, self.barycentric[index].T[..., None]
        # One corner at a time takes half the time of all three at once, and `take` half that of indexing.
        a, b, c = (per_vertex.take(at, 0) * by for at, by in zip(corners, share, strict=True))
        return a + b + c


def unwrap(vertices_m: np.ndarray, faces: np.ndarray, texture_px: int) -> UvLayout:
    """Cut a mesh (V, 3), (F, 3) into charts and pack them into one square with room for dilation between them
    (xatlas)."""
    atlas = xatlas.Atlas()
    # Never freed: xatlas' destructor wakes its threads without holding their lock, sometimes misses one, and hangs.
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(atlas))
    atlas.add_mesh(vertices_m.astype(np.float32), faces.astype(np.uint32))
    packing = xatlas.PackOptions()
    packing.resolution, packing.padding, packing.bilinear = texture_px, CHART_PADDING_PX, True
    atlas.generate(pack_options=packing)
    vertex_of_uv, face_uvs, uvs = atlas[0]
    if not np.array_equal(vertex_of_uv[face_uvs], faces):
        raise RuntimeError("xatlas changed the order of faces; its texture coordinates cannot be matched to the mesh")
    return UvLayout(uvs * (1, -1) + (0, 1), face_uvs.astype(np.int64))


def rasterise(layout: UvLayout, texture_px: int) -> Texels:
    """Return the texels that a layout's faces touch. A texel belongs to the face that contains its centre; to the last
    that touches it, if none does."""
    at_px = (layout.uvs * (1, -1) + (0, 1)) * texture_px - 0.5  # centres at integers
    corners_px = at_px[layout.face_uvs]
    face_image = np.full((texture_px, texture_px), -1, np.int32)
    for index, triangle in enumerate(np.round(corners_px * (1 << SUBPIXEL_BITS)).astype(np.int32)):
        cv2.fillConvexPoly(face_image, triangle, index, shift=SUBPIXEL_BITS)
    row, column = np.nonzero(face_image >= 0)
    p = np.stack([column, row], 1)
    flat = mesh_on_cpu(np.column_stack([at_px, np.zeros(len(at_px))]), layout.face_uvs)
    around = cast(flat, np.column_stack([p, np.ones(len(p))]), np.tile([0.0, 0, -1], (len(p), 1))).face
    face = np.where(around >= 0, around, face_image[row, column])
    a, b, c = corners_px[face].swapaxes(0, 1)
    weights = np.stack([_cross(b - p, c - p), _cross(c - p, a - p), _cross(a - p, b - p)], 1)
    area = weights.sum(1, keepdims=True)
    # If faces only touch a texel, its centre lies outside them.
    inside = np.clip(weights / np.where(area == 0, 1, area), 0, None) + 1e-9
    barycentric = (inside / inside.sum(1, keepdims=True)).astype(np.float32)
    return Texels(row, column, face.astype(np.int64), barycentric)


def texture_image(texels: Texels, colours: np.ndarray, texture_px: int) -> np.ndarray:
    """Return a square RGB texture, uint8, of colours (N, 3) in [0, 1]; texels off the charts repeat the nearest chart's
    border."""
    image = np.zeros((texture_px, texture_px, 3), np.uint8)
    covered = np.zeros((texture_px, texture_px), bool)
    image[texels.row, texels.column] = np.round(colours.clip(0, 1) * 255)
    covered[texels.row, texels.column] = True
    nearest = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return image[nearest[0], nearest[1]]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]

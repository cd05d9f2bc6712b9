"""Tangent frames of a textured mesh, after MikkTSpace (Mikkelsen 2008), which glTF and Blender use, too.

At a vertex, N is the normal, T points along rising u at right angles to N, and B = w N x T along rising v; w is -1
where texture coordinates are mirrored, else 1. Across a face, N and T are interpolated and not scaled to unit length.
Components (x, y, z) describe the direction normalise(x T + y B + z N).
"""

from dataclasses import dataclass

import numpy as np

from hnerf.asset.texture import Texels, UvLayout


@dataclass(frozen=True)
class Frames:
    """Tangent frames at points: normal, tangent, bitangent (N, 3)."""

    normal: np.ndarray
    tangent: np.ndarray
    bitangent: np.ndarray

    def components(self, directions: np.ndarray) -> np.ndarray:
        """Return the components of directions (N, 3) in the frames, as unit vectors (N, 3)."""
        level = self.tangent - _dot(self.tangent, self.normal) / _dot(self.normal, self.normal) * self.normal
        x = _dot(directions, level) / _dot(level, level).clip(1e-12)
        y = _dot(directions, self.bitangent) / _dot(self.bitangent, self.bitangent).clip(1e-12)
        z = _dot(directions - x * self.tangent, self.normal) / _dot(self.normal, self.normal)
        return unit(np.concatenate([x, y, z], 1))


def uv_tangents(points_m: np.ndarray, normals: np.ndarray, faces: np.ndarray, layout: UvLayout) -> np.ndarray:
    """Return the tangent of each texture coordinate, (U, 4): the unit vector T and w. points_m, normals (V, 3); faces
    (F, 3).

    T is the mean of its faces' directions of rising u, made perpendicular to the normal and weighted by the faces'
    angles there. Where mirrored and other faces share a coordinate, w is that of the greater angle.
    """
    count = len(layout.uvs)
    along, mirrored = _rising_u(points_m[faces], layout.uvs[layout.face_uvs])
    angles = corner_angles(points_m[faces])
    corner = layout.face_uvs.ravel()
    normal = np.zeros((count, 3))
    normal[corner] = normals[faces.ravel()]
    level = unit(_at_right_angles(np.repeat(along, 3, 0), normal[corner])) * angles.reshape(-1, 1)
    total = np.stack([np.bincount(corner, axis, count) for axis in level.T], 1)
    turned = np.bincount(corner, (angles * np.where(mirrored, -1, 1)[:, None]).ravel(), count)
    aside = np.eye(3)[np.abs(normal).argmin(1)]  # for coordinates whose faces have no area in the texture
    undirected = np.linalg.norm(total, axis=1, keepdims=True) < 1e-9
    tangent = unit(_at_right_angles(np.where(undirected, aside, total), normal))
    return np.concatenate([tangent, np.where(turned < 0, -1.0, 1.0)[:, None]], 1)


def frames_at(texels: Texels, normals: np.ndarray, faces: np.ndarray, layout: UvLayout, tangents: np.ndarray) -> Frames:
    """Return the frames at texels. normals (V, 3); tangents: of the layout, as `uv_tangents` returns them."""
    normal, turning = texels.interpolate(normals, faces), texels.interpolate(tangents, layout.face_uvs)
    tangent, side = turning[:, :3], np.where(turning[:, 3:] < 0, -1.0, 1.0)
    return Frames(normal, tangent, side * np.cross(normal, tangent))


def corner_angles(triangles: np.ndarray) -> np.ndarray:
    """Return the angles of triangles (F, 3, 3) at their corners, in radians (F, 3)."""
    onward, back = unit(np.roll(triangles, -1, 1) - triangles), unit(np.roll(triangles, 1, 1) - triangles)
    return np.arccos((onward * back).sum(-1).clip(-1, 1))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) scaled to unit length; zero vectors stay zero."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True).clip(1e-20)


def _rising_u(triangles: np.ndarray, uvs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit direction (F, 3) in which u rises on triangles (F, 3, 3) with uvs (F, 3, 2), zero if they have no
    area in the texture, and which triangles are mirrored there, (F,)."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    (u1, v1), (u2, v2) = (uvs[:, 1] - uvs[:, 0]).T, (uvs[:, 2] - uvs[:, 0]).T
    area = u1 * v2 - u2 * v1
    along = np.sign(area)[:, None] * (v2[:, None] * first - v1[:, None] * second)
    return unit(along), area < 0


def _at_right_angles(vectors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the vectors (N, 3) without their parts along unit normals (N, 3)."""
    return vectors - _dot(vectors, normals) * normals


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the dot products (N, 1) of vectors (N, 3)."""
    return (a * b).sum(1, keepdims=True)

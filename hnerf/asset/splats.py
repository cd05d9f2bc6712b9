"""Gaussian splats on the avatar's surface: thin discs that move with its faces, in the colours of its texture."""

from dataclasses import dataclass

import numpy as np

from hnerf.asset.photographs import sampled
from hnerf.asset.rigs import StagedRig
from hnerf.asset.skinning import Skin, largest_first
from hnerf.asset.staging import StagedAvatar
from hnerf.body.descriptor import normals_of

OPACITY = 0.99  # at the centre; renderers allow no more
SPREAD = 1.4  # sigma in radii of a disc with a splat's share of the area: seen from above, 0.4 % shines through
THINNESS = 0.1  # thickness across the surface, in sigma
INFLUENCES = 4  # joints per splat
HARMONIC = 0.28209479177387814  # the spherical harmonic of degree 0
GOLDEN = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class Splats:
    """Splats on a mesh of faces (F, 3). face (N,), barycentric (N, 3): their centres; colours (N, 3): sRGB from 0 to 1;
    sigma_m: standard deviation along the surface."""

    faces: np.ndarray
    face: np.ndarray
    barycentric: np.ndarray
    colours: np.ndarray
    sigma_m: float

    @property
    def scales_m(self) -> np.ndarray:
        """Return the standard deviations (3,) along the axes of a splat, the normal last."""
        return self.sigma_m * np.array([1, 1, THINNESS])

    @property
    def coefficients(self) -> np.ndarray:
        """Return the colours as coefficients (N, 3) of the harmonic of degree 0, to which renderers add 0.5."""
        return (self.colours - 0.5) / HARMONIC

    def at(self, per_vertex: np.ndarray) -> np.ndarray:
        """Interpolate vertex values (V, C) at the splats, (N, C)."""
        corners, share = self.faces[self.face].T, self.barycentric.T[..., None]
        a, b, c = (per_vertex[at] * by for at, by in zip(corners, share, strict=True))
        return a + b + c

    def on(self, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the splats' centres (N, 3), unit normals (N, 3) and orientations (N, 4), as w x y z, on the mesh with
        vertices points_m (V, 3)."""
        normals = self.at(normals_of(points_m, self.faces))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-9)
        return self.at(points_m), normals, turned_to(normals)

    def skin(self, rig: StagedRig) -> Skin:
        """Return the splats' skin: the weights of the surface at each splat, limited to the INFLUENCES strongest
        joints."""
        vertices, joints = len(rig.skin.joints), max(len(rig.skeleton.names), INFLUENCES)
        weights = np.zeros((vertices, joints))
        np.add.at(weights, (np.arange(vertices)[:, None], rig.skin.joints), rig.skin.weights)
        found = self.at(weights)
        return largest_first(np.broadcast_to(np.arange(joints), found.shape), found, INFLUENCES)


def surface_splats(avatar: StagedAvatar, count: int) -> Splats:
    """Return splats that are spread evenly over the surface at rest, at full detail."""
    a, b, c = avatar.rest_points_m[avatar.faces].swapaxes(0, 1)
    areas_m2 = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    face, barycentric = evenly_on_faces(areas_m2, count)
    height_px, width_px = avatar.texture.shape[:2]
    uvs = np.einsum("nk,nkc->nc", barycentric, avatar.uvs[avatar.face_uvs[face]])
    colours = sampled(avatar.texture, uvs * (width_px, -height_px) + (-0.5, height_px - 0.5))
    sigma_m = SPREAD * float(np.sqrt(areas_m2.sum() / (np.pi * count)))
    return Splats(avatar.faces, face, barycentric, colours, sigma_m)


def evenly_on_faces(areas_m2: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return faces (N,) and barycentric coordinates (N, 3) of points that are spread evenly over faces with areas (F,).

    The areas are laid end to end and the points placed on them at equal steps, so that a face gets its share to within
    one point. The place of a point between the ends of its face's area is its first coordinate in the face; multiples
    of the golden ratio are the second. The map of Turk (1990, Generating random points in triangles) then fills the
    triangle evenly.
    """
    ends_m2 = np.cumsum(areas_m2)
    along_m2 = (np.arange(count) + 0.5) / count * ends_m2[-1]
    face = np.searchsorted(ends_m2, along_m2)
    root = np.sqrt((1 - (ends_m2[face] - along_m2) / areas_m2[face]).clip(0, 1))
    second = np.arange(count) * GOLDEN % 1
    return face, np.stack([1 - root, root * (1 - second), root * second], 1)


def turned_to(normals: np.ndarray) -> np.ndarray:
    """Return the smallest rotations of Z to unit normals (N, 3) as unit quaternions (N, 4), w x y z."""
    x, y, z = normals.T
    quaternions = np.stack([1 + z, -y, x, np.zeros_like(z)], 1)
    quaternions[z < -1 + 1e-9] = 0, 1, 0, 0  # opposite: half a turn about any perpendicular axis
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)

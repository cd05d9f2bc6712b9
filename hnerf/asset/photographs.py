"""A texture from the training photographs: each texel's colour as the cameras saw it, on the surface of each frame."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from hnerf.asset.texture import Texels
from hnerf.avatar.avatar import Gains
from hnerf.body.descriptor import normals_of
from hnerf.capture.capture import Capture
from hnerf.geometry.camera import Camera
from hnerf.geometry.rays import cast, mesh_on_cpu
from hnerf.progress import tracked
from hnerf.side_by_side import side_by_side
from hnerf.warp_import import wp

OUTLIER = 0.15  # of a colour in [0, 1]: what differs more from the field is another limb or a passing shadow
COSINE_POWER = 4  # a view's weight is this power of the cosine of its angle to the normal
EDGE_PX = 5  # neighbourhood in which a jump in depth marks an outline, whose pixels mix two surfaces
FEATHER_PX = 8.0  # from an outline inwards, over which a view's weight rises, so that its end leaves no seam
EDGE_SLOPE = 2.5  # depth over width, above which a slope counts as a jump; views so oblique hardly count anyway
DEPTH_TOLERANCE_M = 0.01
FAR_M = 1e3  # depth where a ray hits nothing
BACK_PROJECTIONS = 3  # more would sharpen noise
FIELD_WEIGHT = 0.05  # of the field's colour; a view along the normal weighs 1


@dataclass(frozen=True)
class SeenSurface:
    """The surface of a frame, shared by all cameras: vertices_m (V, 3), faces (F, 3), unit normals (V, 3), and the mesh
    for ray casting."""

    vertices_m: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    mesh: wp.Mesh

    @classmethod
    def of(cls, vertices_m: np.ndarray, faces: np.ndarray) -> "SeenSurface":
        """Prepare the mesh of vertices_m (V, 3) and faces (F, 3)."""
        return cls(vertices_m, faces, normals_of(vertices_m, faces), mesh_on_cpu(vertices_m, faces))


@dataclass(frozen=True)
class TexelPixels:
    """The pixels of a photograph that contain texels. index (M,) int32: the texels; pixel (M,) int32: the row of each
    one's pixel in colours (P, 3), float32 in [0, 1]."""

    index: np.ndarray
    pixel: np.ndarray
    colours: np.ndarray

    def unexplained(self, shown: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """Return the difference (M, 3) between the pixel of each texel and the mean colour of the texels in that pixel.
        shown (M, 3): the colours of the texels; counts (M, 1): their weights in the mean."""
        count = np.bincount(self.pixel, counts[:, 0])[:, None].clip(1e-20)
        total = np.stack([np.bincount(self.pixel, channel) for channel in (counts * shown).T], 1)
        return (self.colours - total / count).astype(np.float32).take(self.pixel, 0)


class BackProjection:
    """Iterative back-projection (Irani and Peleg 1991). It sharpens a weighted mean over photographs, whose pixels
    average their texels, so that the texels, averaged over pixels again, look like the photographs.

    Both means have the same weights. If texels that hardly count, such as those of an eyeball close behind its lid, had
    a full share of their pixels, the others there would be changed to make up for them.
    """

    def __init__(self) -> None:
        self._views: list[tuple[TexelPixels, np.ndarray, np.ndarray | float]] = []

    def add(self, pixels: TexelPixels, counts: np.ndarray, light: np.ndarray | float = 1.0) -> None:
        """Add a photograph. counts (M, 1): the weights of its texels; light (M, 1): the light in which it shows
        them."""
        self._views.append((pixels, counts.astype(np.float32), light))

    def sharpened(self, mean: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Return the mean (N, 3), of total weight (N, 1), sharpened, in [0, 1]."""
        colours = np.clip(mean, 0, 1).astype(np.float32)
        for _ in range(BACK_PROJECTIONS):
            change = np.zeros_like(colours)
            for pixels, counts, light in self._views:
                shown = colours.take(pixels.index, 0) * light
                change[pixels.index] += counts * pixels.unexplained(shown, counts)
            colours = np.clip(colours + change / weight, 0, 1).astype(np.float32)
        return colours


@dataclass(frozen=True)
class SeenTexels:
    """Texels as a photograph shows them. pixels: those that contain them; cosine (M,): between the view and their unit
    normals (M, 3); feather (M,): in (0, 1], below 1 next to outlines; colours (M, 3): in [0, 1], interpolated between
    pixels and divided by the camera's gains."""

    pixels: TexelPixels
    cosine: np.ndarray
    feather: np.ndarray
    normals: np.ndarray
    colours: np.ndarray

    @property
    def index(self) -> np.ndarray:
        """Return the index (M,) of the texels."""
        return self.pixels.index

    def weights(self, expected: np.ndarray) -> np.ndarray:
        """Return the weight of each texel, (M, 1): the fourth power of the cosine, reduced next to outlines, and the
        more its colour contradicts the expected one (M, 3) (Geman-McClure)."""
        error = (self.colours - expected) / OUTLIER
        return (self.feather * self.cosine**COSINE_POWER / (1 + _dot(error, error)) ** 2)[:, None]


class CapturedBlend:
    """The mean colour of texels over photographs, sharpened, and weighted by the agreement with the field's colours (N,
    3). These have a small weight everywhere, so that they fill what no photograph shows."""

    def __init__(self, field_colours: np.ndarray) -> None:
        self._field = field_colours.astype(np.float32)
        self._weight = np.full((len(field_colours), 1), FIELD_WEIGHT)
        self._total = FIELD_WEIGHT * field_colours
        self._projection = BackProjection()

    def add(self, seen: SeenTexels) -> None:
        """Add a photograph."""
        counts = seen.weights(self._field.take(seen.index, 0))
        self._weight[seen.index] += counts
        self._total[seen.index] += counts * seen.colours
        self._projection.add(seen.pixels, counts)

    @property
    def unseen(self) -> np.ndarray:
        """Return the texels that no photograph shows, (N,) bool."""
        return self._weight[:, 0] == FIELD_WEIGHT

    def colours(self) -> np.ndarray:
        """Return the colours (N, 3) in [0, 1]."""
        return self._projection.sharpened(self._total / self._weight, self._weight)


def photographed_texels(
    capture: Capture, gains: Gains, surfaces: Mapping[int, SeenSurface], texels: Texels
) -> Iterator[SeenTexels]:
    """Yield what each training photograph of the frames in `surfaces` shows of the texels: those that the surface does
    not hide, away from outlines."""

    def seen_in(view: tuple[int, str]) -> SeenTexels:
        frame, name = view
        camera, gain = capture.cameras[name], np.array(gains.get(name, (1.0, 1.0, 1.0)), np.float32)
        image = capture.image(name, frame)
        index, cosine, feather, normals, pixels_px = visible_texels(camera, surfaces[frame], texels)
        x, y = np.round(pixels_px).astype(int).T
        at, pixel = np.unique(y * camera.width_px + x, return_inverse=True)
        colours = (image.reshape(-1, 3)[at] / 255 / gain).astype(np.float32)
        pixels = TexelPixels(index.astype(np.int32), pixel.astype(np.int32), colours)
        return SeenTexels(pixels, cosine, feather, normals, sampled(image, pixels_px) / gain)

    views = list(product(surfaces, capture.train_cameras))
    yield from tracked(side_by_side(seen_in, views), "photographs", len(views))


def visible_texels(
    camera: Camera, surface: SeenSurface, texels: Texels
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return which texels (M,) a camera sees away from outlines, the cosines of its view to their normals (M,), the
    share of FEATHER_PX by which they are away (M,), at most 1, these unit normals (M, 3), and their pixels (M, 2)."""
    vertices_m, faces, normals = surface.vertices_m, surface.faces, surface.normals
    towards = camera.centre_m - vertices_m
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    facing = ((normals * towards).sum(1) > 0)[faces].any(1)
    index = np.flatnonzero(facing[texels.face])
    points_m, normal = np.hsplit(texels.interpolate(np.hstack([vertices_m, normals]), faces, index), 2)
    pixels_px, depth_m = camera.project(points_m)
    view_m = camera.centre_m.astype(points_m.dtype) - points_m
    distance_m = np.sqrt(_dot(view_m, view_m))
    normal = normal / np.sqrt(_dot(normal, normal)).clip(1e-9)[:, None]
    cosine = _dot(view_m, normal) / distance_m
    seen_m, outline = _depth(camera, surface)
    at_px = np.round(pixels_px)
    inside = camera.holds(at_px) & (cosine > 0) & (depth_m > 0)  # what is behind the camera would be seen mirrored
    column, row = np.where(inside[:, None], at_px, 0).astype(int).T
    visible = inside & ~outline[row, column] & (distance_m < seen_m[row, column] + DEPTH_TOLERANCE_M / cosine.clip(0.1))
    away_px = cv2.distanceTransform((~outline).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)[row, column]
    feather = (away_px / FEATHER_PX).clip(max=1)
    return index[visible], cosine[visible], feather[visible], normal[visible], pixels_px[visible]


def _depth(camera: Camera, surface: SeenSurface) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance (H, W) at which each pixel's ray hits a surface, and where it jumps, (H, W) bool."""
    at_px, ahead_m = camera.project(surface.vertices_m)
    if not (ahead_m > 0).all():  # what reaches past the camera may show anywhere
        at_px = np.array([(0, 0), camera.size_px])
    box_px = np.stack([np.floor(at_px.min(0)) - EDGE_PX, np.ceil(at_px.max(0)) + EDGE_PX + 1])
    lower, upper = box_px.clip(0, camera.size_px).astype(int)
    depth_m = np.full((camera.height_px, camera.width_px), FAR_M, np.float32)
    x, y = np.meshgrid(np.arange(lower[0], upper[0]), np.arange(lower[1], upper[1]))
    hits = cast(surface.mesh, *camera.rays(np.stack([x.ravel(), y.ravel()], 1).astype(float)))
    depth_m[y.ravel(), x.ravel()] = np.where(hits.face >= 0, hits.distance_m, FAR_M)
    window = np.ones((EDGE_PX, EDGE_PX), np.uint8)
    near_m = cv2.erode(depth_m, window)
    width_m = (EDGE_PX - 1) * near_m / camera.K[0, 0]
    return depth_m, cv2.dilate(depth_m, window) - near_m > EDGE_SLOPE * width_m


def sampled(image: np.ndarray, pixels_px: np.ndarray) -> np.ndarray:
    """Return the colours (M, 3) float32 in [0, 1] at points (M, 2) of an image (H, W, 3) uint8, by bilinear
    interpolation. Points beyond the border take the border's colours."""
    height_px, width_px = image.shape[:2]
    x, y = pixels_px.T.clip(0, np.array([[width_px - 1], [height_px - 1]]))
    left, top = x.astype(np.int64), y.astype(np.int64)
    right, below = np.minimum(left + 1, width_px - 1), np.minimum(top + 1, height_px - 1)
    across, down = ((at - whole).astype(np.float32)[:, None] for at, whole in ((x, left), (y, top)))
    colours = image.reshape(-1, 3)

    def along(row: np.ndarray) -> np.ndarray:
        a, b = (colours.take(row * width_px + column, 0) / np.float32(255) for column in (left, right))
        return a + across * (b - a)

    upper = along(top)
    return upper + down * (along(below) - upper)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the dot products (M,) of the rows of two arrays (M, 3). A sum along so short an axis would be slower."""
    return np.einsum("mk,mk->m", a, b)

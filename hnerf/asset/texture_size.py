"""The size of the texture, by evidence: a texel is half the finest pixel of the photographs that the texture is made
from."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hnerf.asset.baking import MOST_TEXELS
from hnerf.asset.texture import UvLayout
from hnerf.asset.topologies import AssetMesh
from hnerf.capture.capture import Capture

FINEST = 0.05  # of what photographs show has finer pixels: a hand held out to a camera decides nothing
TEXELS_PER_PIXEL = 2  # side by side: pixels of several photographs lie differently, so together they show more than one
SMALLEST_PX, LARGEST_PX = 1024, 8192  # with 512, images of 256 px lose sharpness (docs/experiments.md)
FEWEST_FRAMES = 4  # photographed; fewer, for want of memory, lose more than texels gain (docs/experiments.md)

log = logging.getLogger("hnerf.asset")


@dataclass(frozen=True)
class TextureSize:
    """How fine a texture is. px: its side; texel_m: width of a texel on the surface, the median by area; pixel_m: of
    the photographs' finest pixels there, None without photographs."""

    px: int
    texel_m: float
    pixel_m: float | None

    def figures(self) -> dict[str, float | None]:
        """Return these sizes for the report."""
        pixel_mm = None if self.pixel_m is None else 1e3 * self.pixel_m
        return {"texture_px": self.px, "texel_mm": 1e3 * self.texel_m, "source_pixel_mm": pixel_mm}


def texture_size(
    capture: Capture, surfaces_m: Sequence[np.ndarray], mesh: AssetMesh, given_px: int | None
) -> tuple[TextureSize, UvLayout]:
    """Return the size of a mesh's texture and its layout. surfaces_m: the mesh in each photographed frame, (V, 3), in
    the world; given_px: the side, None to let the photographs decide."""
    vertices_m, faces = mesh.rig.vertices_m.double().numpy(), mesh.rig.faces.numpy()
    pixel_m = finest_pixel_m(capture, surfaces_m, faces)
    px, layout = given_px or SMALLEST_PX, mesh.layout(given_px or SMALLEST_PX)
    if given_px is None:
        photographs = min(len(surfaces_m), FEWEST_FRAMES) * len(capture.train_cameras)
        px = fitting_px(texture_width_m(vertices_m, faces, layout), pixel_m, photographs)
        layout = layout if px == SMALLEST_PX else mesh.layout(px)  # charts of another mesh, packed anew, differ by 3 %
    size = TextureSize(px, texture_width_m(vertices_m, faces, layout) / px, pixel_m)
    shown = "no photographs" if pixel_m is None else f"photographs have pixels down to {1e3 * pixel_m:.2g} mm"
    log.info("%s: texture of %d px, %.2g mm a texel; %s", capture.name, px, 1e3 * size.texel_m, shown)
    return size, layout


def finest_pixel_m(capture: Capture, surfaces_m: Sequence[np.ndarray], faces: np.ndarray) -> float | None:
    """Return the width on the surface of the finest pixels of the training photographs, at normal incidence (depth over
    focal length): the FINEST quantile by area over surfaces and cameras. None if no camera sees a surface.

    surfaces_m: each (V, 3), of a frame, in the world; faces (F, 3). What is hidden by something else counts, too.
    """
    widths_m, areas_m2 = [np.zeros(0)], [np.zeros(0)]
    for surface_m in surfaces_m:
        a, b, c = surface_m[faces].swapaxes(0, 1)
        centres_m, normals_m2 = (a + b + c) / 3, np.cross(b - a, c - a) / 2
        for camera in (capture.cameras[name] for name in capture.train_cameras):
            pixels_px, depth_m = camera.project(centres_m)
            facing = ((camera.centre_m - centres_m) * normals_m2).sum(1) > 0
            seen = facing & camera.holds(pixels_px) & (depth_m > 0)
            widths_m.append(depth_m[seen] / camera.K[0, 0])
            areas_m2.append(np.linalg.norm(normals_m2[seen], axis=1))
    found_m = np.concatenate(widths_m)
    return _quantile(found_m, np.concatenate(areas_m2), FINEST) if len(found_m) else None


def texture_width_m(vertices_m: np.ndarray, faces: np.ndarray, layout: UvLayout) -> float:
    """Return how wide the whole texture is on a surface (V, 3), (F, 3): the median by area, since the head's texels are
    smaller than others. Divided by the texture's side in texels, this is the width of a texel."""
    a, b, c = vertices_m[faces].swapaxes(0, 1)
    areas_m2 = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    a, b, c = layout.uvs[layout.face_uvs].astype(np.float64).swapaxes(0, 1)
    shares = np.abs(np.linalg.det(np.stack([b - a, c - a], 1))) / 2  # of the texture's square
    return _quantile(np.sqrt(areas_m2 / shares.clip(1e-12)), areas_m2, 0.5)


def fitting_px(width_m: float, pixel_m: float | None, photographs: int) -> int:
    """Return the side of a texture that is width_m wide on the surface: the power of two, from SMALLEST_PX to
    LARGEST_PX, with which a texel is closest to half of a pixel of pixel_m. It is smaller if that many photographs
    would take too much memory (`photographed_frames`), and SMALLEST_PX without a pixel."""
    if pixel_m is None:
        return SMALLEST_PX
    wanted_px = 2 ** round(np.log2(TEXELS_PER_PIXEL * width_m / pixel_m))
    affordable_px = 2 ** int(np.log2(MOST_TEXELS / photographs) / 2)
    return max(SMALLEST_PX, min(wanted_px, affordable_px, LARGEST_PX))


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    return float(np.quantile(values, share, weights=weights, method="inverted_cdf"))

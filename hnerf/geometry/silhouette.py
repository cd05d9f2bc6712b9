"""Rasterised silhouettes of triangle meshes."""

import numpy as np

from hnerf.geometry.camera import Camera
from hnerf.warp_import import wp

NEAR_M = 1e-3  # minimum depth of a vertex; triangles with a nearer vertex are not drawn


@wp.func
def _edge_function(a: wp.vec2d, b: wp.vec2d, p: wp.vec2d) -> wp.float64:
    """Return the edge function of the line a b at p: twice the signed area of triangle a, b, p."""
    return (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])  # type: ignore[index]


@wp.kernel
def _rasterise_kernel(
    faces: wp.array2d(dtype=wp.int32),
    corners_px: wp.array(dtype=wp.vec2d),
    in_front: wp.array(dtype=wp.bool),
    image: wp.array2d(dtype=wp.uint8),
) -> None:
    f = wp.tid()
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    if in_front[i] and in_front[j] and in_front[k]:
        a, b, c = corners_px[i], corners_px[j], corners_px[k]
        low, high = wp.min(wp.min(a, b), c), wp.max(wp.max(a, b), c)
        for y in range(wp.max(int(wp.ceil(low[1])), 0), wp.min(int(wp.floor(high[1])), image.shape[0] - 1) + 1):
            for x in range(wp.max(int(wp.ceil(low[0])), 0), wp.min(int(wp.floor(high[0])), image.shape[1] - 1) + 1):
                p = wp.vec2d(wp.float64(x), wp.float64(y))
                e, g, h = _edge_function(a, b, p), _edge_function(b, c, p), _edge_function(c, a, p)
                if wp.min(wp.min(e, g), h) >= wp.float64(0.0) or wp.max(wp.max(e, g), h) <= wp.float64(0.0):
                    image[y, x] = wp.uint8(1)


def silhouette(camera: Camera, vertices_m: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the silhouette of a mesh, (H, W) bool: True where the ray through the pixel's centre meets a triangle.

    vertices_m (V, 3) world; faces (F, 3). Evaluates edge functions (Pineda 1988) at the pixel centres of each
    triangle's bounding box. Triangles that reach behind the camera are not drawn.
    """
    uv, depth_m = camera.project(np.asarray(vertices_m, np.float64))
    image = wp.zeros((camera.height_px, camera.width_px), dtype=wp.uint8, device="cpu")
    inputs = [
        wp.array(np.ascontiguousarray(faces, np.int32), dtype=wp.int32, device="cpu"),
        wp.array(np.ascontiguousarray(uv), dtype=wp.vec2d, device="cpu"),
        wp.array(depth_m > NEAR_M, dtype=wp.bool, device="cpu"),
    ]
    wp.launch(_rasterise_kernel, dim=len(faces), inputs=[*inputs, image], device="cpu")
    return image.numpy().astype(bool)

"""Pictures for people: masks, overlays, error maps and shaded surfaces, (H, W, 3) uint8 RGB all."""

import base64
import dataclasses

import cv2
import numpy as np
import trimesh

from hnerf.evaluation.metrics import mask_box
from hnerf.geometry.camera import Camera
from hnerf.geometry.mesh_queries import Surface
from hnerf.geometry.rays import RayHits

PICTURE_PX = (300, 400)  # width, height of a picture in the report
SUPERSAMPLING = 2
ACCENT = np.array([255, 122, 26], np.float32)  # orange: seldom worn, seen on any ground
PAPER = np.array([255, 255, 255], np.float32)
KEY_LIGHT = np.array([-0.40, -0.56, -0.72])  # towards the light in camera axes: from above left, behind the camera
FULL_ERROR = 0.25  # difference, of 1, that the error map shows brightest
FULL_DISTANCE_M = 0.03  # distance that the surface map shows darkest
DISTANCE_COLOURS = np.array([[214, 208, 200], [247, 190, 90], [222, 84, 44], [112, 10, 40]], np.float32)  # even steps


def data_uri(picture: np.ndarray) -> str:
    """A picture as a JPEG inside an address."""
    encoded, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 90])
    assert encoded
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def frame_person(person: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns around a person (H, W) bool, as near to a report picture's proportions as the image allows."""
    image_height, image_width = person.shape
    box = mask_box(person if person.any() else np.ones_like(person))
    rows, columns = range(image_height)[box[0]], range(image_width)[box[1]]
    width, height = PICTURE_PX
    wanted_rows, wanted_columns = len(columns) * height // width, len(rows) * width // height
    return (
        _widened(rows, max(len(rows), wanted_rows), image_height),
        _widened(columns, max(len(columns), wanted_columns), image_width),
    )


def _widened(part: range, length: int, limit: int) -> slice:
    """A part of [0, limit) made `length` long about its middle, moved to stay inside."""
    length = min(length, limit)
    start = min(max(0, part.start - (length - len(part)) // 2), limit - length)
    return slice(start, start + length)


def crop(picture: np.ndarray, box: tuple[slice, slice]) -> np.ndarray:
    """The box at the height that pictures have in the report."""
    part = picture[box]
    height, width = part.shape[:2]
    method = cv2.INTER_CUBIC if height < PICTURE_PX[1] else cv2.INTER_AREA
    return cv2.resize(part, _report_size(width, height), interpolation=method)


def cropped_camera(camera: Camera, box: tuple[slice, slice]) -> Camera:
    """The camera whose whole image is `crop` of this one's."""
    rows, columns = box
    K = camera.K - np.array([[0, 0, columns.start], [0, 0, rows.start], [0, 0, 0]])
    width, height = columns.stop - columns.start, rows.stop - rows.start
    part = dataclasses.replace(camera, K=K, width_px=width, height_px=height)
    return part.resized(*_report_size(width, height))


def _report_size(width: int, height: int) -> tuple[int, int]:
    return round(width * PICTURE_PX[1] / height), PICTURE_PX[1]


def show_mask(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The image dimmed outside its mask (H, W) bool, the mask outlined."""
    dimmed = np.where(mask[..., None], image, image // 5)
    return _outline(dimmed, mask)


def overlay_surface(image: np.ndarray, surface: Surface, camera: Camera) -> np.ndarray:
    """The image with a surface over it, tinted and outlined."""
    hits = _cast(surface, camera)
    shade = _headlight(surface.mesh, hits, camera)[..., None]
    hit = (hits.face >= 0).reshape(image.shape[:2])
    tinted = np.where(hit[..., None], 0.45 * image + 0.55 * ACCENT * shade, image)
    return _outline(tinted.astype(np.uint8), hit)


def error_map(rendered: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Mean absolute difference of the channels: black is none, the brightest FULL_ERROR or more."""
    error = np.abs(rendered.astype(np.float32) - reference).mean(-1) / 255
    return _colours(error / FULL_ERROR)


def clay(surface: Surface, camera: Camera) -> np.ndarray:
    """The surface as a grey model on white."""
    fine = _finer(camera)
    hits = _cast(surface, fine)
    return _developed(DISTANCE_COLOURS[0] * _studio_light(surface.mesh, hits, fine), hits, camera)


def distance_map(surface: Surface, truth: Surface, camera: Camera) -> np.ndarray:
    """The model coloured by its distance to the truth: grey is none, dark red FULL_DISTANCE_M or more."""
    fine = _finer(camera)
    hits = _cast(surface, fine)
    met = hits.face >= 0
    distance_m, _ = truth.closest(hits.interpolate(surface.mesh.vertices, surface.mesh.faces))
    steps = np.linspace(0, FULL_DISTANCE_M, len(DISTANCE_COLOURS))
    colours = np.zeros((len(met), 3), np.float32)
    colours[met] = np.stack([np.interp(distance_m, steps, channel) for channel in DISTANCE_COLOURS.T], 1)
    return _developed(colours * _studio_light(surface.mesh, hits, fine), hits, camera)


def portrait_camera(points_m: np.ndarray, root: np.ndarray, side: str) -> Camera:
    """A long lens that looks at a person's "front" or "back", points (N, 3) of the surface filling the picture.

    root (4, 4): world from body, whose axes are Z up, facing -Y.
    """
    width_px, height_px = PICTURE_PX
    towards = root[:3, 1] if side == "front" else -root[:3, 1]
    down = -root[:3, 2]
    R = np.stack([np.cross(down, towards), down, towards])
    x = points_m @ R.T
    middle, half = (x.max(0) + x.min(0)) / 2, (x.max(0) - x.min(0)) / 2
    distance_m = 5.0 + half[2]
    focal_px = 0.47 * min(width_px / half[0], height_px / half[1]) * (distance_m - half[2])
    K = np.array([[focal_px, 0, (width_px - 1) / 2], [0, focal_px, (height_px - 1) / 2], [0, 0, 1]])
    return Camera(side, K, R, np.array([0, 0, distance_m]) - middle, width_px, height_px)


def _cast(surface: Surface, camera: Camera) -> RayHits:
    """Hits of the rays through a camera's pixels, row by row."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), -1).reshape(-1, 2)
    return surface.cast(*camera.rays(pixels.astype(np.float64)))


def _normals(mesh: trimesh.Trimesh, hits: RayHits) -> np.ndarray:
    """Smooth unit normals (N, 3) at hits, 0 where there is none."""
    normals = np.zeros((len(hits.face), 3))
    smooth = hits.interpolate(mesh.vertex_normals, mesh.faces)
    normals[hits.face >= 0] = smooth / np.linalg.norm(smooth, axis=1, keepdims=True).clip(1e-9)
    return normals


def _studio_light(mesh: trimesh.Trimesh, hits: RayHits, camera: Camera) -> np.ndarray:
    """Brightness (N, 1) under a key light, a lamp at the camera, and light from all around."""
    normals = _normals(mesh, hits) @ camera.R.T
    light = 0.30 + 0.62 * (normals @ KEY_LIGHT).clip(0, 1) + 0.16 * (-normals[:, 2]).clip(0, 1)
    return light[:, None]


def _headlight(mesh: trimesh.Trimesh, hits: RayHits, camera: Camera) -> np.ndarray:
    """Brightness (H, W) under a lamp at the camera."""
    facing = -(_normals(mesh, hits) @ camera.R.T)[:, 2]
    return (0.35 + 0.65 * facing.clip(0, 1)).reshape(camera.height_px, camera.width_px)


def _finer(camera: Camera) -> Camera:
    return camera.resized(camera.width_px * SUPERSAMPLING, camera.height_px * SUPERSAMPLING)


def _developed(colours: np.ndarray, hits: RayHits, camera: Camera) -> np.ndarray:
    """Colours of fine rays (N, 3), of 255, over white paper at the camera's own size."""
    fine = np.where(hits.face[:, None] >= 0, colours, PAPER).astype(np.float32)
    fine = fine.reshape(camera.height_px * SUPERSAMPLING, camera.width_px * SUPERSAMPLING, 3)
    size = (camera.width_px, camera.height_px)
    return cv2.resize(fine, size, interpolation=cv2.INTER_AREA).clip(0, 255).astype(np.uint8)


def _colours(values: np.ndarray) -> np.ndarray:
    """Values in [0, 1] (...,) to colours (..., 3)."""
    levels = (values.clip(0, 1) * 255).astype(np.uint8)
    bgr = cv2.applyColorMap(np.atleast_2d(levels), cv2.COLORMAP_INFERNO)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).reshape(*levels.shape, 3)


def _outline(picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.ascontiguousarray(picture), contours, -1, ACCENT.tolist(), 1, cv2.LINE_AA)

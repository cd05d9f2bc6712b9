"""Images for the report: masks, overlays, error maps and shaded surfaces, all (H, W, 3) uint8 RGB."""

import base64
import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np
import trimesh

from hnerf.evaluation.metrics import mask_box
from hnerf.geometry.camera import Camera
from hnerf.geometry.mesh_queries import Surface
from hnerf.geometry.rays import RayHits

PICTURE_PX = (300, 400)  # width, height of an image in the report
SUPERSAMPLING = 2
ACCENT = np.array([255, 122, 26], np.float32)  # orange: rare in clothes, visible on any background
BACKGROUND = np.array([255, 255, 255], np.float32)
KEY_LIGHT = np.array([-0.40, -0.56, -0.72])  # towards the light in camera axes: from above left, behind the camera
FULL_ERROR = 0.25  # difference, in a range of 1, that the error map shows brightest
FULL_DISTANCE_M = 0.03  # distance that the surface map shows darkest
# Colours at equal steps of distance.
DISTANCE_COLOURS = np.array([[214, 208, 200], [247, 190, 90], [222, 84, 44], [112, 10, 40]], np.float32)


def data_uri(picture: np.ndarray) -> str:
    """Encode an image as a JPEG data URI."""
    encoded, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 90])
    assert encoded
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def shrunk(picture: np.ndarray, longest_px: int) -> np.ndarray:
    """Return an image, shrunk if its longer side exceeds `longest_px`."""
    scale = longest_px / max(picture.shape[:2])
    return cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else picture


def frame_person(person: np.ndarray) -> tuple[slice, slice]:
    """Return rows and columns around a person (H, W) bool, as close to the aspect ratio of PICTURE_PX as the image
    allows."""
    image_height, image_width = person.shape
    box = mask_box(person if person.any() else np.ones_like(person))
    rows, columns = range(image_height)[box[0]], range(image_width)[box[1]]
    width, height = PICTURE_PX
    wanted_rows, wanted_columns = len(columns) * height // width, len(rows) * width // height
    return _widened(rows, wanted_rows, image_height), _widened(columns, wanted_columns, image_width)


def _widened(part: range, length: int, limit: int) -> slice:
    """Widen a part of [0, limit) that is shorter than `length` about its middle, shifted to stay inside."""
    length = min(max(length, len(part)), limit)
    start = min(max(0, part.start - (length - len(part)) // 2), limit - length)
    return slice(start, start + length)


def crop(picture: np.ndarray, box: tuple[slice, slice]) -> np.ndarray:
    """Return the box of an image, scaled to the height of images in the report."""
    part = picture[box]
    height, width = part.shape[:2]
    method = cv2.INTER_CUBIC if height < PICTURE_PX[1] else cv2.INTER_AREA
    return cv2.resize(part, _report_size(width, height), interpolation=method)


def cropped_camera(camera: Camera, box: tuple[slice, slice]) -> Camera:
    """Return the camera whose whole image is `crop` of this one's."""
    part = camera_of_box(camera, box)
    return part.resized(*_report_size(*part.size_px))


def camera_of_box(camera: Camera, box: tuple[slice, slice]) -> Camera:
    """Return the camera whose whole image is a box, rows and columns, of this one's; slices may end beyond it."""
    rows, columns = range(camera.height_px)[box[0]], range(camera.width_px)[box[1]]
    K = camera.K - np.array([[0, 0, columns.start], [0, 0, rows.start], [0, 0, 0]])
    return dataclasses.replace(camera, K=K, width_px=len(columns), height_px=len(rows))


def _report_size(width: int, height: int) -> tuple[int, int]:
    return round(width * PICTURE_PX[1] / height), PICTURE_PX[1]


def show_mask(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the image dimmed outside its mask (H, W) bool, with the mask outlined."""
    dimmed = np.where(mask[..., None], image, image // 5)
    return _outline(dimmed, mask)


def overlay_surface(image: np.ndarray, surface: Surface, camera: Camera) -> np.ndarray:
    """Return the image with a surface drawn over it, tinted and outlined."""
    hits = cast_pixels(surface, camera)
    shade = _headlight(surface.mesh, hits, camera)[..., None]
    hit = (hits.face >= 0).reshape(image.shape[:2])
    tinted = np.where(hit[..., None], 0.45 * image + 0.55 * ACCENT * shade, image)
    return _outline(tinted.astype(np.uint8), hit)


def error_map(rendered: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the mean absolute difference over channels as colours: black is none, the brightest FULL_ERROR or more."""
    error = np.abs(rendered.astype(np.float32) - reference).mean(-1) / 255
    levels = ((error / FULL_ERROR).clip(0, 1) * 255).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)


@dataclass(frozen=True)
class Shot:
    """A surface as a camera sees it, to be drawn in one style or another. fine: the camera with SUPERSAMPLING times the
    pixels along each side; hits: those of its pixels' rays, row by row."""

    mesh: trimesh.Trimesh
    camera: Camera
    fine: Camera
    hits: RayHits

    def averaged(self, colours: np.ndarray) -> np.ndarray:
        """Return the image (H, W, 3) uint8 of the rays' colours (N, 3), 0 to 255, on white."""
        fine = np.where(self.hits.face[:, None] >= 0, colours, BACKGROUND).astype(np.float32)
        fine = fine.reshape(self.fine.height_px, self.fine.width_px, 3)
        return cv2.resize(fine, self.camera.size_px, interpolation=cv2.INTER_AREA).clip(0, 255).astype(np.uint8)


def shoot(surface: Surface, camera: Camera) -> Shot:
    """Cast the rays of a camera's supersampled image."""
    fine = camera.scaled(SUPERSAMPLING)
    return Shot(surface.mesh, camera, fine, cast_pixels(surface, fine))


def clay(shot: Shot) -> np.ndarray:
    """Render the surface as a grey model on white."""
    return shot.averaged(DISTANCE_COLOURS[0] * studio_light(shot))


def distance_map(shot: Shot, truth: Surface) -> np.ndarray:
    """Render the surface coloured by its distance to the truth: grey is none, dark red FULL_DISTANCE_M or more."""
    met = shot.hits.face >= 0
    distance_m, _ = truth.closest(shot.hits.interpolate(shot.mesh.vertices, shot.mesh.faces))
    steps = np.linspace(0, FULL_DISTANCE_M, len(DISTANCE_COLOURS))
    colours = np.zeros((len(met), 3), np.float32)
    colours[met] = np.stack([np.interp(distance_m, steps, channel) for channel in DISTANCE_COLOURS.T], 1)
    return shot.averaged(colours * studio_light(shot))


def portrait_camera(points_m: np.ndarray, ahead: np.ndarray, up: np.ndarray) -> Camera:
    """Return a camera of long focal length that looks along a direction (3,) at surface points (N, 3) and frames them;
    up (3,): at right angles to it."""
    width_px, height_px = PICTURE_PX
    R = np.stack([np.cross(ahead, up), -up, ahead])
    x = points_m @ R.T
    middle, half = (x.max(0) + x.min(0)) / 2, (x.max(0) - x.min(0)) / 2
    distance_m = 5.0 + half[2]
    focal_px = 0.47 * min(width_px / half[0], height_px / half[1]) * (distance_m - half[2])
    K = np.array([[focal_px, 0, (width_px - 1) / 2], [0, focal_px, (height_px - 1) / 2], [0, 0, 1]])
    return Camera("portrait", K, R, np.array([0, 0, distance_m]) - middle, width_px, height_px)


def cast_pixels(surface: Surface, camera: Camera) -> RayHits:
    """Return the hits of the rays through a camera's pixels, row by row."""
    return surface.cast(*camera.rays(camera.pixels_px.reshape(-1, 2)))


def normals_at(mesh: trimesh.Trimesh, hits: RayHits) -> np.ndarray:
    """Return smooth unit normals (N, 3) at hits, 0 where a ray hits nothing."""
    normals = np.zeros((len(hits.face), 3))
    smooth = hits.interpolate(mesh.vertex_normals, mesh.faces)
    normals[hits.face >= 0] = smooth / np.linalg.norm(smooth, axis=1, keepdims=True).clip(1e-9)
    return normals


def studio_light(shot: Shot) -> np.ndarray:
    """Return the brightness (N, 1) of rays under a key light, a light at the camera, and ambient light."""
    normals = normals_at(shot.mesh, shot.hits) @ shot.camera.R.T
    light = 0.30 + 0.62 * (normals @ KEY_LIGHT).clip(0, 1) + 0.16 * (-normals[:, 2]).clip(0, 1)
    return light[:, None]


def _headlight(mesh: trimesh.Trimesh, hits: RayHits, camera: Camera) -> np.ndarray:
    """Return the brightness (H, W) under a light at the camera."""
    facing = -(normals_at(mesh, hits) @ camera.R.T)[:, 2]
    return (0.35 + 0.65 * facing.clip(0, 1)).reshape(camera.height_px, camera.width_px)


def _outline(picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.ascontiguousarray(picture), contours, -1, ACCENT.tolist(), 1, cv2.LINE_AA)

"""Images of the asset for its report, drawn from its own arrays: turntable, wireframe, joints, texture; (H, W, 3) uint8
RGB."""

import base64
import io
from collections.abc import Sequence

import cv2
import numpy as np
import trimesh
from PIL import Image

from hnerf.asset.skeleton import UP
from hnerf.asset.splat_rendering import render_splats
from hnerf.asset.splats import OPACITY, Splats
from hnerf.asset.srgb import to_linear, to_srgb
from hnerf.asset.staging import StagedAvatar
from hnerf.evaluation.pictures import ACCENT, SUPERSAMPLING, Shot, normals_at, portrait_camera, shoot, studio_light
from hnerf.geometry.camera import Camera
from hnerf.geometry.mesh_queries import Surface
from hnerf.geometry.rays import RayHits

LINE_PX = 0.7  # width of an edge in a wireframe
SHIFT = 4  # fractional bits of a pixel's coordinates, as OpenCV draws
JOINT_PX = 1.6  # radius of a joint
WEBP_QUALITY = 85
PAPER, LINE = np.array([236.0, 233, 228]), np.array([47.0, 111, 181])


def turntable_cameras(points_m: np.ndarray, facing: np.ndarray, count: int) -> list[Camera]:
    """Return level cameras around a person, evenly spaced from the front. points_m (N, 3): the surface, Y up; facing
    (3,): where the person looks."""
    headings_rad = np.arctan2(facing[0], facing[2]) + np.arange(count) * 2 * np.pi / count
    return [portrait_camera(points_m, np.array([-np.sin(h), 0, -np.cos(h)]), UP) for h in headings_rad]


def textured(shot: Shot, avatar: StagedAvatar) -> np.ndarray:
    """Render a posed surface of the avatar with its texture, without light, on white."""
    return shot.averaged(_texture_colours(shot, avatar, avatar.texture))


def looks_on_black(
    surface: Surface, avatar: StagedAvatar, camera: Camera, size_px: tuple[int, int], gain: tuple[float, float, float]
) -> dict[str, np.ndarray]:
    """Render a posed surface of the avatar as a camera exposes it: (H, W, 4) uint8, over black with coverage, averaged
    down to size_px (width, height). The looks are "asset", with the captured texture, and, if there is one, "albedo",
    in its light."""
    shot = shoot(surface, camera)
    colours = {"asset": _texture_colours(shot, avatar, avatar.texture)}
    if avatar.albedo:
        normals = normals_at(shot.mesh, shot.hits) @ avatar.stage_from_world.T
        unlit = to_linear(_texture_colours(shot, avatar, avatar.albedo.texture) / 255)
        lit = to_srgb(unlit * avatar.albedo.light.irradiance(normals)[:, None])
        colours["albedo"] = (255 * lit).astype(np.float32)
    return {look: _exposed(found, shot, size_px, gain) for look, found in colours.items()}


def _exposed(colours: np.ndarray, shot: Shot, size_px: tuple[int, int], gain: tuple[float, float, float]) -> np.ndarray:
    """Expose the colours (N, 3), from 0 to 255, of a camera's rays with its gain; return an image as in
    `looks_on_black`."""
    fine, hits = shot.fine, shot.hits
    exposed = np.minimum(colours * np.array(gain, np.float32), 255)
    pixels = np.concatenate([exposed, np.full((len(exposed), 1), 255, np.float32)], 1) * (hits.face[:, None] >= 0)
    averaged = cv2.resize(pixels.reshape(fine.height_px, fine.width_px, 4), size_px, interpolation=cv2.INTER_AREA)
    return averaged.round().astype(np.uint8)


def splats_on_black(
    splats: Splats, points_m: np.ndarray, camera: Camera, size_px: tuple[int, int], gain: tuple[float, float, float]
) -> np.ndarray:
    """Render splats on a mesh with vertices points_m (V, 3), as in `looks_on_black`."""
    middles_m, _, quaternions = splats.on(points_m)
    exposed = np.minimum(splats.colours * np.array(gain), 1)
    fine = render_splats(middles_m, quaternions, splats.scales_m, OPACITY, exposed, camera.scaled(SUPERSAMPLING))
    averaged = cv2.resize(255 * fine, size_px, interpolation=cv2.INTER_AREA)
    return averaged.round().astype(np.uint8)


def _texture_colours(shot: Shot, avatar: StagedAvatar, texture: np.ndarray) -> np.ndarray:
    """Return a texture's colours at the hits of rays, (N, 3) float32 from 0 to 255, undefined where a ray hits
    nothing."""
    fine, hits = shot.fine, shot.hits
    height_px, width_px = texture.shape[:2]
    texel_px = np.zeros((len(hits.face), 2), np.float32)  # centres at integers, rows from the top
    uv = hits.interpolate(avatar.uvs, avatar.face_uvs)
    texel_px[hits.face >= 0] = uv * (width_px, -height_px) + (-0.5, height_px - 0.5)
    columns, rows = texel_px.reshape(fine.height_px, fine.width_px, 2).transpose(2, 0, 1)
    colours = cv2.remap(texture, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return colours.reshape(-1, 3).astype(np.float32)


def wireframe(shot: Shot) -> np.ndarray:
    """Render the edges of the surface's faces that a camera sees, on white."""
    hits = shot.hits
    colours = np.zeros((len(hits.face), 3), np.float32)
    pixel_m = hits.distance_m[hits.face >= 0] / shot.fine.K[0, 0]
    edge = _to_edge_m(shot.mesh, hits) < LINE_PX * pixel_m
    colours[hits.face >= 0] = np.where(edge[:, None], LINE, PAPER)
    return shot.averaged(colours * studio_light(shot))


def _to_edge_m(mesh: trimesh.Trimesh, hits: RayHits) -> np.ndarray:
    """Return the distance from each hit to the nearest edge of its face: the least product of a barycentric coordinate
    and the height over its edge."""
    met = hits.face >= 0
    corners_m = mesh.vertices[mesh.faces[hits.face[met]]]
    edges_m = np.linalg.norm(np.roll(corners_m, -1, 1) - np.roll(corners_m, -2, 1), axis=2)  # opposite to each corner
    heights_m = 2 * mesh.area_faces[hits.face[met]][:, None] / edges_m.clip(1e-9)
    return (hits.barycentric[met] * heights_m).min(1)


def uv_picture(avatar: StagedAvatar, side_px: int) -> np.ndarray:
    """Draw the faces in the square of texture coordinates, on white."""
    picture = np.full((side_px, side_px, 3), 255, np.uint8)
    corners_px = (avatar.uvs * (1, -1) + (0, 1))[avatar.face_uvs] * side_px - 0.5
    fixed = _fixed(corners_px)
    for triangle in fixed:  # one by one: in one call, overlapping ones would cancel out
        cv2.fillConvexPoly(picture, triangle, PAPER.tolist(), cv2.LINE_AA, SHIFT)
    return cv2.polylines(picture, list(fixed), True, LINE.tolist(), 1, cv2.LINE_AA, SHIFT)


def joints_over(picture: np.ndarray, camera: Camera, positions_m: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Draw joints at positions_m (J, 3), and lines to their parents (J,), over a camera's image. The root, whose parent
    is -1, has no line to it: it stands on the ground."""
    drawn, at = picture.copy(), _fixed(camera.project(positions_m)[0])
    for joint, parent in enumerate(parents):
        if parent >= 0 and parents[parent] >= 0:
            cv2.line(drawn, at[parent], at[joint], LINE.tolist(), 1, cv2.LINE_AA, SHIFT)
    for joint in at:
        cv2.circle(drawn, joint, round(JOINT_PX * 2**SHIFT), ACCENT.tolist(), cv2.FILLED, cv2.LINE_AA, SHIFT)
    return drawn


def moving_uri(pictures: Sequence[np.ndarray], each_ms: int) -> str:
    """Encode images, shown one after another for each_ms in a loop, as the data URI of a WebP file."""
    first, *others = map(Image.fromarray, pictures)
    file = io.BytesIO()
    first.save(
        file, "WEBP", save_all=True, append_images=others, duration=each_ms, loop=0, quality=WEBP_QUALITY, method=2
    )
    return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode()


def _fixed(points_px: np.ndarray) -> np.ndarray:
    """Return pixel coordinates as integers with SHIFT fractional bits."""
    return (points_px * 2**SHIFT).round().astype(np.int32)

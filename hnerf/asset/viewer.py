"""The page on which anyone can turn the avatar: one HTML file that works offline and makes no network requests.

It carries avatar.glb, lower levels of detail, photographs of the recording, three.js and the modules under `page/`,
which do the work.
"""

import base64
import gzip
import json
import logging
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hnerf.asset.compact_glb import compact_glb
from hnerf.asset.levels import Level
from hnerf.asset.staging import opengl_pose
from hnerf.capture.capture import Capture
from hnerf.evaluation.pictures import data_uri, shrunk
from hnerf.evaluation.report import report_environment
from hnerf.evenly_spaced import evenly_spaced
from hnerf.geometry.camera import Camera
from hnerf.models import ADVICE, LICENCES, THREE_SHA256, has_model, model_file

PAGE = Path(__file__).parent / "page"
MAX_BYTES = 8_000_000
GZIP_LEVEL = 6  # 9 takes nine times as long for 4 % less
TEXTURES_PX = (8192, 4096, 2048, 1024, 512)  # tried in turn until the page is small enough
CAMERAS, PHOTOGRAPHS = 8, 5  # at most; photographs are of each camera
PHOTOGRAPH_PX = 384  # longer side
RELATIVE_IMPORT = re.compile(r"from '\.{1,2}/(?:[\w./]*/)?([\w.]+\.js)'")  # as in three.js

log = logging.getLogger("hnerf.asset")


def write_viewer(path: Path, glb: Path, capture: Capture, stage_from_world: np.ndarray, levels: Sequence[Level]) -> str:
    """Write the page of an avatar. Return its name, or, if three.js is not installed, a line that says so, which is
    logged, too. Raises PlaceError if a file of three.js is altered.

    stage_from_world (3, 3): from the capture's world to the avatar's; levels: of detail, the first that of the file.
    The texture is halved until the page has at most MAX_BYTES; if that does not suffice, a warning is logged.
    """
    if not all(map(has_model, THREE_SHA256)):
        reason = f"no {path.name}: three.js is not installed; {ADVICE}"
        log.warning("%s", reason)
        return reason
    parts: dict[str, Any] = {
        "title": capture.name,
        "style": (PAGE / "viewer.css").read_text(encoding="utf-8"),
        "boot": (PAGE / "boot.js").read_text(encoding="utf-8"),
        "licence": (LICENCES / "three.txt").read_text(encoding="utf-8"),
        "modules": _packed(json.dumps(_modules()).encode()),
        "levels": _packed(json.dumps(lower_indices(levels)).encode()),
        "recording": _packed(json.dumps(recording(capture, stage_from_world)).encode()),
    }
    template = report_environment(PAGE).get_template("viewer.html")
    written, before = glb.read_bytes(), b""
    for texture_px in TEXTURES_PX:
        compact = compact_glb(written, texture_px)
        if compact == before:  # its texture was no larger anyway
            continue
        before, page = compact, template.render(avatar=_packed(compact), **parts)
        if len(page.encode()) <= MAX_BYTES:
            break
    else:
        log.warning(
            "%s: over %d MB even with a small texture: the motion is long or the mesh fine",
            path.name,
            MAX_BYTES // 10**6,
        )
    path.write_text(page, encoding="utf-8")
    return path.name


def recording(capture: Capture, stage_from_world: np.ndarray) -> dict[str, Any]:
    """Return the data of the capture that the page shows: its time, and training cameras with photographs of training
    frames.

    Instants are seconds from the first frame. `pose`: that of `opengl_pose`, row by row.
    """
    names = evenly_spaced(capture.train_cameras, CAMERAS)
    frames = evenly_spaced(capture.train_frames, PHOTOGRAPHS)
    return {
        "fps": capture.fps,
        "first_frame": capture.frames[0],
        "cameras": [
            _camera(capture.cameras[name], stage_from_world)
            | {"photographs": [_photograph(capture, name, frame) for frame in frames]}
            for name in names
        ],
    }


def lower_indices(levels: Sequence[Level]) -> list[list[int]]:
    """Return the triangles of each level of detail below the first, as indices into the vertices of avatar.glb: those
    of the first, one for each row of its texture coordinates."""
    row_of = {corner: row for level in levels[:1] for corner, row in _corners(level)}
    return [[row_of[corner] for corner, _ in _corners(level)] for level in levels[1:]]


def _corners(level: Level) -> Iterator[tuple[tuple[int, float, float], int]]:
    """Yield the vertex and the texture coordinates of each corner of a level's faces, and the row of the latter."""
    rows = level.layout.face_uvs.ravel()
    vertices, uvs = level.vertices[level.faces.ravel()].tolist(), level.layout.uvs[rows].tolist()
    for vertex, (u, v), row in zip(vertices, uvs, rows.tolist(), strict=True):
        yield (vertex, u, v), row


def _camera(camera: Camera, stage_from_world: np.ndarray) -> dict[str, Any]:
    pose = opengl_pose(camera, stage_from_world)
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    size = {"width": camera.width_px, "height": camera.height_px}
    return {"name": camera.name, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **size, "pose": pose.ravel().tolist()}


def _photograph(capture: Capture, camera: str, frame: int) -> dict[str, Any]:
    image = shrunk(capture.image(camera, frame), PHOTOGRAPH_PX)
    return {"frame": frame, "time_s": (frame - capture.frames[0]) / capture.fps, "jpeg": data_uri(image)}


def _modules() -> dict[str, str]:
    """Return the sources by the names under which they import each other: "three", "three/..." and "viewer/...". Raises
    PlaceError if a file of three.js is missing or altered."""
    three = {f"three/{name}": model_file(name).read_text(encoding="utf-8") for name in THREE_SHA256}
    three = {name: RELATIVE_IMPORT.sub(r"from 'three/\1'", source) for name, source in three.items()}
    paths = [path for path in sorted(PAGE.glob("*.js")) if path.name != "boot.js"]
    own = {f"viewer/{path.name}": path.read_text(encoding="utf-8") for path in paths}
    return {"three": three.pop("three/three.module.js")} | three | own


def _packed(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, GZIP_LEVEL, mtime=0)).decode()

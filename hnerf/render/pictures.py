"""Renderings of an avatar as files: colour, depth, normals, mask and mesh of each shot, and a video of each kind of
image."""

import math
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from hnerf.avatar.avatar import Avatar, Rendering
from hnerf.avatar.surface import normals_and_distances, posed_surface
from hnerf.body.observations import MAX_GAP
from hnerf.capture.capture import read_rgb, write_image
from hnerf.capture.footage import MIN_FPS, Video
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera
from hnerf.progress import tracked

COVERED = 0.5  # alpha from which a pixel has a depth and a normal
NEAR_GREY, FAR_GREY = 255, 64  # grey levels at the ends of a depth video's range
NORMAL_STEP_M = 0.005  # of differences of the signed distance
Shot = tuple[Camera, int]  # a camera, and the frame of avatar.body whose pose is shown


def write_pictures(avatar: Avatar, shots: Sequence[Shot], what: Sequence[str], fps: float, out: Path) -> None:
    """Write `<kind>/<number>.png` (`.ply` for mesh) for every shot and each kind in `what`, and the images of each kind
    as `<kind>.mp4`. fps: of the frame numbers; a picture lasts as long as its frame (`frame_times`).

    colour: 8-bit over black. mask: coverage, 0 to 255. depth: 16-bit, millimetres along the viewing axis, 0 off the
    person. normals: 8-bit, (n + 1) / 2 with x right, y up, z towards the camera, black off the person. mesh: the
    surface in world metres. The depth video is greyscale: see `read_depth_grey`.
    """
    for kind in what:
        (out / kind).mkdir(parents=True)
    meshes: dict[int, Path] = {}  # by frame: an orbit round one pose shows it many times
    for number, shot in enumerate(tracked(shots, "rendering", len(shots))):
        images = _render_kinds(avatar, shot, what)
        for kind, image in images.items():
            write_image(out / kind / f"{number:06d}.png", image)
        if "mesh" in what:
            mesh = out / "mesh" / f"{number:06d}.ply"
            if shot[1] in meshes:
                shutil.copyfile(meshes[shot[1]], mesh)
            else:
                posed_surface(avatar, shot[1]).export(mesh)
                meshes[shot[1]] = mesh
    rate, lasts = frame_times([frame for _, frame in shots], fps)
    for kind in [kind for kind in what if kind != "mesh"]:
        read = partial(read_depth_grey, span_mm=depth_span_mm(out / kind)) if kind == "depth" else read_rgb
        write_video(out / kind, rate, lasts, out / f"{kind}.mp4", read)


def frame_times(frames: Sequence[int], fps: float) -> tuple[float, list[int]]:
    """Return the rate of a video that shows frames of these numbers, `fps` of them a second, and for how many of its
    own frames it shows each. A gap of more than MAX_GAP median steps is shown as one of MAX_GAP."""
    gaps = np.diff(frames)
    ahead = gaps[gaps > 0]  # none if one pose is shown again and again; after the last frame, the first may follow
    step = int(np.gcd.reduce(ahead)) if len(ahead) else 1
    lasts = np.minimum(gaps, MAX_GAP * np.median(ahead) if len(ahead) else 1) // step
    return fps / step, [*lasts.clip(min=1).astype(int).tolist(), 1]


def write_video(
    folder: Path, fps: float, lasts: Sequence[int], path: Path, read: Callable[[Path], np.ndarray] = read_rgb
) -> None:
    """Encode the PNG files of a folder, in order, as an MPEG-4 video of at least MIN_FPS; `read` loads each as (H, W,
    3) uint8 RGB. lasts: how many frames of the video each is shown for. Raises OSError if not all frames can be read
    back."""
    files = sorted(folder.glob("*.png"))
    height_px, width_px = read(files[0]).shape[:2]
    fps = max(fps, MIN_FPS)  # two frames may be an hour apart; below about 0.001, no file would be written
    fps = round(fps, max(0, int(math.log10(65535 / fps))))  # MPEG-4's clock has at most 65535 ticks a second
    # FFmpeg takes what precedes a colon in a relative path for a protocol.
    writer = cv2.VideoWriter(str(path.absolute()), cv2.VideoWriter.fourcc(*"mp4v"), fps, (width_px, height_px))
    for file, times in zip(files, lasts, strict=True):
        picture = cv2.cvtColor(read(file), cv2.COLOR_RGB2BGR)
        for _ in range(times):
            writer.write(picture)
    writer.release()
    count = 0
    with suppress(InputError):  # a file that was cut short by a full disk
        count = len(Video.open(path).frames)
    if count != sum(lasts):
        raise OSError(f"{path}: {count} of {sum(lasts)} frames were written")


def depth_span_mm(folder: Path) -> tuple[int, int]:
    """Return the smallest and largest depth of the person in a folder's depth images, in mm; (65535, 0) if no image
    shows the person."""
    depths_mm = (np.array(Image.open(file)) for file in folder.glob("*.png"))
    spans_mm = [(d.min(where=d > 0, initial=65535), d.max()) for d in depths_mm]
    return min(int(near) for near, _ in spans_mm), max(int(far) for _, far in spans_mm)


def read_depth_grey(path: Path, span_mm: tuple[int, int]) -> np.ndarray:
    """Read a depth image as greyscale (H, W, 3) uint8: white at the near end of the span, dark at the far end, linear
    in between, black off the person."""
    depth_mm = np.array(Image.open(path))
    near_mm, far_mm = span_mm
    away = (depth_mm.astype(np.float32) - near_mm) / max(far_mm - near_mm, 1)
    grey = np.where(depth_mm > 0, NEAR_GREY + (FAR_GREY - NEAR_GREY) * away, 0)
    return grey.round().astype(np.uint8)[..., None].repeat(3, -1)


def depth_image(rendering: Rendering, camera: Camera) -> Tensor:
    """Return depths along the viewing axis, (H, W) uint16 in mm, from a rendering's depths along its rays."""
    _, directions = camera.rays(camera.pixels_px)
    ahead = torch.from_numpy(directions @ camera.forward).to(rendering.depth_m)
    return (1000 * rendering.depth_m * ahead * (rendering.alpha > COVERED)).round().clamp(0, 65535).to(torch.uint16)


@torch.no_grad()
def normal_image(avatar: Avatar, rendering: Rendering, camera: Camera, theta: Tensor, root: Tensor) -> Tensor:
    """Return surface normals as an image (H, W, 3) uint8, encoded as in `write_pictures`: the gradient of the signed
    distance where rays end."""
    covered = (rendering.alpha > COVERED) & (rendering.depth_m > 0)  # a mixed pixel's centre may miss the person
    origins, directions = (torch.from_numpy(a.copy()).to(rendering.depth_m) for a in camera.rays(camera.pixels_px))
    points_m = origins[covered] + rendering.depth_m[covered][:, None] * directions[covered]
    normals, _ = normals_and_distances(avatar, points_m, theta, root, NORMAL_STEP_M)
    seen = normals @ torch.from_numpy(camera.R.T).to(points_m)
    image = torch.zeros(*covered.shape, 3, dtype=torch.uint8, device=covered.device)
    image[covered] = (127.5 * (seen * seen.new_tensor([1, -1, -1]) + 1)).round().to(torch.uint8)
    return image


def _render_kinds(avatar: Avatar, shot: Shot, what: Sequence[str]) -> dict[str, np.ndarray]:
    """Render a shot once and return the requested kinds that are images, greyscale or RGB."""
    camera, frame = shot
    if set(what) <= {"mesh"}:
        return {}
    theta, root = avatar.body.pose(frame)
    seen = avatar.render(camera, theta, root)
    kinds: dict[str, Callable[[], Tensor]] = {
        "colour": lambda: (255 * seen.rgb).round().to(torch.uint8),
        "mask": lambda: (255 * seen.alpha).round().clamp(0, 255).to(torch.uint8),
        "depth": lambda: depth_image(seen, camera),
        "normals": lambda: normal_image(avatar, seen, camera, theta, root),
    }
    return {kind: make().cpu().numpy() for kind, make in kinds.items() if kind in what}

"""A synthetic subject: a ball that a stand-in avatar renders in one colour, seen by cameras around it."""

import json
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from hnerf.avatar.avatar import Rendering
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture, write_image
from hnerf.capture.masks import Masks, encode
from hnerf.evaluation import geometry
from hnerf.evaluation.inputs import EvaluationInputs
from hnerf.geometry.camera import Camera, look_at
from tests.body.boxes import hinged

RADIUS_M = 0.1
SIZE_PX = 64
FRAMES = (0, 1, 2, 3)  # the last is the novel pose
NOVEL = (3,)
RENDERED, PHOTOGRAPHED = 102, 153  # grey levels from 0 to 255
TUNED_M = 0.02  # training raised the body of the novel frame by this: two pixels


@dataclass(frozen=True)
class BallAvatar:
    """The avatar of a grey ball with exact distances. Its learned per-frame changes make it darker."""

    body: BodyFit
    grey: float = RENDERED
    frames_darken_by: float = 0

    def without_frames(self) -> "BallAvatar":
        return replace(self, frames_darken_by=0)

    def with_body(self, body: BodyFit) -> "BallAvatar":
        return replace(self, body=body)

    def render(self, camera: Camera, theta: Tensor, root: Tensor) -> Rendering:
        alpha = torch.from_numpy(ball_mask(camera, root[:3, 3].numpy())).float()
        grey = (self.grey - self.frames_darken_by) / 255
        return Rendering(alpha[..., None].expand(-1, -1, 3) * grey, alpha, alpha)

    def frame_displacements(self, points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        raise NotImplementedError

    def signed_distance(self, points_m: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        return (points_m - root[:3, 3]).norm(dim=1) - RADIUS_M

    def colour(self, points_m: Tensor, directions: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        raise NotImplementedError


def centre_m(frame: int) -> np.ndarray:
    """Return the ball's centre in a frame."""
    return np.array([0.01 * frame, 0.0, 1.0])


def ball_mask(camera: Camera, middle_m: np.ndarray) -> np.ndarray:
    """Return the mask (H, W) bool of pixels whose rays hit the ball."""
    origins, directions = camera.rays(camera.pixels_px)
    offset = np.cross(middle_m - origins, directions)
    return np.linalg.norm(offset, axis=-1) < RADIUS_M


def ball_camera(name: str, turn_deg: float) -> Camera:
    """Return a camera 0.75 m away, at the ball's height, that looks at (0, 0, 1)."""
    like = Camera(name, np.diag([80.0, 80, 1]), np.eye(3), np.zeros(3), SIZE_PX, SIZE_PX)
    angle, target_m, up = np.deg2rad(turn_deg), np.array([0.0, 0, 1]), np.array([0, 0, 1])
    return look_at(like, target_m + 0.75 * np.array([np.cos(angle), np.sin(angle), 0]), target_m, up)


def ball_fit() -> BodyFit:
    """Return the ball as a body whose second joint moves nothing."""
    ball = trimesh.creation.icosphere(3, RADIUS_M)
    vertices_m, faces = torch.from_numpy(ball.vertices).float(), torch.from_numpy(ball.faces).long()
    rig = hinged(vertices_m, faces, torch.zeros(2, 3), ("root", "other"), torch.zeros(len(vertices_m)))
    root = torch.eye(4).repeat(len(FRAMES), 1, 1)
    root[:, :3, 3] = torch.tensor(np.stack([centre_m(f) for f in FRAMES]), dtype=torch.float32)
    return BodyFit(rig, FRAMES, torch.zeros(len(FRAMES), 2, 3), root)


def write_ball_capture(folder: Path, test_cameras: tuple[str, ...] = ("c",), name: str = "ball") -> Capture:
    """Write images of a ball on grey from cameras "a", "b" and the test cameras, and a `capture.toml` as in
    recordings."""
    names = ("a", "b", *test_cameras)
    cameras = {n: ball_camera(n, 80.0 * k) for k, n in enumerate(names)}
    sizes = dict.fromkeys(names, (SIZE_PX, SIZE_PX))
    capture = Capture(name, folder, cameras, ("a", "b"), test_cameras, FRAMES[:-1], NOVEL, 10.0, "z", sizes, sizes)
    for camera in cameras.values():
        for frame in FRAMES:
            image = np.where(ball_mask(camera, centre_m(frame)), PHOTOGRAPHED, 60).astype(np.uint8)
            write_image(folder / "images" / camera.name / f"{frame:06d}.png", image)
    (folder / "capture.toml").write_text(
        f"[cameras]\ntrain = ['a', 'b']\ntest = {list(test_cameras)}\n"
        f"[frames]\ntrain = {list(FRAMES[:-1])}\nnovel_pose = {list(NOVEL)}\n"
    )
    return capture


def write_ball_truth(capture: Capture, radius_m: float | None = RADIUS_M, masked: tuple[int, ...] = FRAMES) -> None:
    """Write `ground_truth/` with exact masks of frames and, if a radius is given, a true surface for frame 0."""
    for camera in capture.cameras.values():
        for frame in masked:
            mask = ball_mask(camera, centre_m(frame)).astype(np.uint8) * 255
            write_image(capture.root / "ground_truth" / "masks" / camera.name / f"{frame:06d}.png", mask)
    if radius_m is None:
        return
    ball = trimesh.creation.icosphere(5, radius_m)
    vertices = (ball.vertices + centre_m(0))[None].astype(np.float32)
    path = capture.root / "ground_truth" / "meshes.npz"
    np.savez(path, faces=ball.faces, vertices=vertices, frames=np.array([0]))


def write_ball_masks(capture: Capture, camera: str) -> None:
    """Write a camera's masks as if they came with its recording, without the left half of the ball."""
    for frame in FRAMES:
        mask = ball_mask(capture.cameras[camera], centre_m(frame)).astype(np.uint8) * 255
        mask[:, : SIZE_PX // 2] = 0
        write_image(capture.root / "masks" / camera / f"{frame:06d}.png", mask)


def tuned(fit: BodyFit) -> BodyFit:
    """Return the fit with the body of the novel frame raised."""
    root = fit.root.clone()
    root[FRAMES.index(NOVEL[0]), 2, 3] += TUNED_M
    return replace(fit, root=root)


def write_settings(training: Path, kind: str = "fast", nodes: int = 8, steps: int = 80) -> None:
    """Write the parts of training's settings.json that decide which novel-pose columns exist."""
    fast = kind == "fast"
    settings: dict[str, Any] = {"pose_learning_rate": 5e-4 * fast, "novel_pose_steps": steps}
    settings |= {"field": {"kind": kind} | ({"nodes": nodes} if fast else {})}
    (training / "settings.json").write_text(json.dumps({"static": False, "training": settings}))


def coarse_surfaces(patch: pytest.MonkeyPatch) -> None:
    """Extract and compare surfaces on coarse grids, fine enough for the values worked out by hand, and draw small
    images of them."""
    patch.setattr("hnerf.avatar.surface.POSED_CELLS", 96)
    patch.setattr("hnerf.evaluation.pictures.PICTURE_PX", (75, 100))
    patch.setattr(geometry, "score_geometry", partial(geometry.score_geometry, samples=10_000, nodes=64))


def ball_inputs(capture: Capture) -> EvaluationInputs:
    """Return all inputs of evaluation, with a new folder for each earlier stage."""
    fit, stages = ball_fit(), capture.root / "stages"
    folders = {f"{name}_folder": stages / name for name in ("calibration", "segmentation", "fit", "training")}
    for folder in folders.values():
        folder.mkdir(parents=True)
    write_settings(folders["training_folder"])
    return EvaluationInputs(
        capture_folder=capture.root,
        capture=capture,
        masks=Masks(
            {(n, f): encode(ball_mask(capture.cameras[n], centre_m(f))) for n in ("a", "b") for f in FRAMES}, {}
        ),
        fitted=fit,
        avatar=BallAvatar(fit),
        **folders,
    )

"""A recording that a static method learns in seconds: a ball, coloured by its normal, in front of a grey background.
The body fitted to it is a unit box, so only its extent reveals anything about the ball."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import torch

from hnerf.avatar.avatar import Avatar
from hnerf.avatar.trained import load_avatar
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture, write_image
from hnerf.capture.masks import Masks, encode
from hnerf.config import TrainingSettings
from hnerf.geometry.camera import Camera
from hnerf.training.trainer import train
from tests.body.boxes import box_rig
from tests.training.scene import ALONE, SIZE_PX, look_at

MIDDLE_M, RADIUS_M = np.full(3, 0.5), 0.35
RING = tuple("01234567")  # every 45 degrees


def render(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Render the ball from a camera: colour (H, W, 3) in [0, 255], black outside the ball, and mask (H, W)."""
    y, x = np.mgrid[:SIZE_PX, :SIZE_PX]
    origins, directions = camera.rays(np.stack([x.ravel(), y.ravel()], 1).astype(np.float64))
    points_on_rays = ((MIDDLE_M - origins) * directions).sum(1)
    beside_sq = ((MIDDLE_M - origins) ** 2).sum(1) - points_on_rays**2
    mask = beside_sq < RADIUS_M**2
    depth = points_on_rays - np.sqrt(np.maximum(RADIUS_M**2 - beside_sq, 0))
    normal = (origins + depth[:, None] * directions - MIDDLE_M) / RADIUS_M
    colour = np.where(mask[:, None], 127.5 + 100 * normal, 0)
    return colour.reshape(SIZE_PX, SIZE_PX, 3), mask.reshape(SIZE_PX, SIZE_PX)


def body() -> BodyFit:
    """Return a unit box as the fitted body of the ball."""
    return BodyFit(box_rig(splits=4), (0,), torch.zeros(1, 2, 3), torch.eye(4)[None])


def record(folder: Path) -> tuple[Capture, Masks, BodyFit]:
    """Write a recording of one frame from eight training cameras to `folder`."""
    cameras, masks = {}, {}
    for k, name in enumerate(RING):
        turn = k * np.pi / 4
        camera = look_at(name, MIDDLE_M + np.array([2 * np.cos(turn), 2 * np.sin(turn), 0.4]), MIDDLE_M)
        colour, mask = render(camera)
        write_image(folder / "images" / name / "000000.png", np.where(mask[..., None], colour, 128))
        write_image(folder / "background" / f"{name}.png", np.full_like(colour, 128))
        cameras[name], masks[name, 0] = camera, encode(mask)
    sizes = dict.fromkeys(cameras, (SIZE_PX, SIZE_PX))
    capture = Capture("ball", folder, cameras, RING, (), (0,), (), 10.0, "z", sizes, sizes)
    return capture, Masks(masks, {}), body()


def trained(folder: Path, settings: TrainingSettings, cameras: tuple[str, ...]) -> Avatar:
    """Train on the ball with the given cameras of the ring."""
    capture, masks, fit = record(folder / "capture")
    capture = dataclasses.replace(capture, train_cameras=cameras)
    (folder / "out").mkdir()
    train(capture, masks, fit, settings, folder / "out", ALONE)
    return load_avatar(folder / "out", "cpu")


def psnr(avatar: Avatar, folder: Path, name: str) -> float:
    """Return the PSNR of a ring camera's whole image, rendered over black."""
    camera = record(folder / "capture")[0].cameras[name]
    drawn = avatar.render(camera, avatar.body.theta[0], avatar.body.root[0])
    wanted = torch.from_numpy(render(camera)[0] / 255).float()
    return float(-10 * torch.log10(((drawn.rgb - wanted) ** 2).mean()))


def inner_psnr(avatar: Avatar, folder: Path, name: str) -> tuple[float, float]:
    """Return the PSNR of the ball's colours at least two pixels inside its outline, and the PSNR of their mean colour
    there."""
    camera = record(folder / "capture")[0].cameras[name]
    colour, mask = render(camera)
    inside = torch.from_numpy(cv2.erode(mask.astype(np.uint8), np.ones((5, 5))) > 0)
    wanted = torch.from_numpy(colour / 255).float()[inside]
    drawn = avatar.render(camera, avatar.body.theta[0], avatar.body.root[0]).rgb[inside]
    errors = torch.stack([(found - wanted).square().mean() for found in (drawn, wanted.mean(0))])
    return tuple((-10 * errors.log10()).tolist())


def radii_m(avatar: Avatar, directions: torch.Tensor) -> torch.Tensor:
    """Return the distance (N,) of the outermost surface from the ball's centre along directions (N, 3)."""
    steps_m = torch.linspace(0, 1, 201)
    points = torch.from_numpy(MIDDLE_M).float() + directions[:, None] * steps_m[:, None]
    inside = avatar.signed_distance(points.flatten(0, 1), avatar.body.theta[0], avatar.body.root[0]).view(-1, 201) < 0
    return (inside * steps_m).amax(1)

"""A recording small enough to train on in seconds: a bending red column in front of a grey plate, four cameras, images
of 32 x 32 pixels."""

from pathlib import Path
from types import ModuleType

import numpy as np
import torch

from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture, write_image
from hnerf.capture.masks import Masks, encode
from hnerf.config import TrainingSettings
from hnerf.fields import fast
from hnerf.geometry.camera import Camera
from hnerf.geometry.silhouette import silhouette
from hnerf.render import trajectory
from hnerf.training import fixed_rays, parts
from hnerf.training.distributed import Distributed
from tests.body.boxes import box_rig

ALONE = Distributed(0, 1, torch.device("cpu"))
SIZE_PX = 32
FRAMES = (0, 1, 2)

TINY_FIELDS = {
    "fast": {
        "kind": "fast",
        "spacing_m": 0.09,
        "geometry_cells": [4],
        "colour_cells": [4],
        "width": 8,
        "pose_width": 8,
        "outer_m": 0.2,
        "inner_m": 0.1,
        "shell_cell_m": 0.05,
    },
    "paper": {"kind": "paper", "samples": 4},
    "nerf": {"kind": "nerf", "samples": 4, "width": 8},
    "idr": {"kind": "idr", "samples": 4, "width": 8},
    "nerfies": {"kind": "nerfies", "samples": 4, "width": 8, "deformation_width": 8},
}
TINY = TrainingSettings.model_validate(
    {
        "field": TINY_FIELDS["fast"],
        "losses": {"mask": 0, "blend": 0, "geometry": 0, "fit": 0, "increment": 0},
        "steps": 12,
        "novel_pose_steps": 4,
        "frames_per_step": 2,
        "rays_per_frame": 64,
        "absorb_steps": 5,
        "checkpoint_steps": 6,
    }
)

# For trainings of a dozen steps. Their surface is not worth checking, so few rays are rendered for the check and the
# held-out PSNR; the shell is tightened in coarse steps; and the memory per ray is measured on small batches.
SHRUNK_CONSTANTS: tuple[tuple[ModuleType, str, float], ...] = (
    (fixed_rays, "MIN_PERSON_COVERAGE", 0.0),
    (fixed_rays, "RAYS", 64),
    (fast, "TIGHTEN_STEP_M", 0.02),
    (parts, "FEW_RAYS", 4),
    (parts, "MORE_RAYS", 8),
)


def tiny(kind: str = "fast", **changes: object) -> TrainingSettings:
    """Return minimal settings for a kind of field, with changes."""
    return TrainingSettings.model_validate(TINY.model_dump() | {"field": TINY_FIELDS[kind]} | changes)


def look_at(name: str, centre_m: np.ndarray, target_m: np.ndarray) -> Camera:
    """Return a camera at `centre_m` that sees `target_m` in the image centre, z up."""
    like = Camera(name, np.diag([1.2 * SIZE_PX, 1.2 * SIZE_PX, 1]), np.eye(3), np.zeros(3), SIZE_PX, SIZE_PX)
    return trajectory.look_at(like, centre_m, target_m, np.array([0, 0, 1]))


def record(folder: Path, bends_rad: tuple[float, ...] = (0.0, 0.2, 0.4)) -> tuple[Capture, Masks, BodyFit]:
    """Write the recording to `folder`, with the column bent by these angles in its frames; frame 2 is a novel pose."""
    rig = box_rig(bend_segments=6, splits=2)
    theta = torch.zeros(len(FRAMES), 2, 3)
    theta[:, 1, 1] = torch.tensor(bends_rad)
    body = BodyFit(rig, FRAMES, theta, torch.eye(4).repeat(len(FRAMES), 1, 1))
    middle = np.array([0.5, 0.5, 1.0])
    directions = [(4, 0), (0, 4), (-4, 0), (0, -4)]
    cameras = {f"{k}": look_at(f"{k}", middle + np.array([x, y, 0.5]), middle) for k, (x, y) in enumerate(directions)}
    masks = {}
    red, plate = np.array([200, 50, 50], np.uint8), np.full((SIZE_PX, SIZE_PX, 3), 128, np.uint8)
    for name, camera in cameras.items():
        for row, frame in enumerate(FRAMES):
            mask = silhouette(camera, body.vertices_m()[row].numpy(), rig.faces.numpy())
            masks[name, frame] = encode(mask)
            write_image(folder / "images" / name / f"{frame:06d}.png", np.where(mask[..., None], red, plate))
        write_image(folder / "background" / f"{name}.png", plate)
    sizes = dict.fromkeys(cameras, (SIZE_PX, SIZE_PX))
    capture = Capture("column", folder, cameras, tuple(cameras), (), FRAMES[:2], FRAMES[2:], 10.0, "z", sizes, sizes)
    return capture, Masks(masks, {}), body

"""Train a dynamic method in seconds on the bending column (tests/training/scene.py) with two frames and four
cameras."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch

from hnerf.avatar.avatar import Avatar
from hnerf.avatar.trained import load_avatar
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.config import TrainingSettings
from hnerf.training.trainer import train
from tests.body.boxes import box_rig
from tests.training.scene import ALONE, record


@dataclass(frozen=True, eq=False)
class Learned:
    """A recording and the avatar trained on its frames 0 and 1."""

    capture: Capture
    body: BodyFit
    avatar: Avatar

    @cache  # noqa: B019 there are few instances, which live as long as their tests
    def psnr(self, frame: int) -> float:
        """Return the PSNR of a frame over all cameras, rendered over the photographs' background."""
        errors = []
        for name, camera in self.capture.cameras.items():
            drawn = self.avatar.render(camera, self.body.theta[frame], self.body.root[frame])
            plate = self.capture.background(name)
            assert plate is not None
            shown = drawn.rgb + (1 - drawn.alpha[..., None]) * torch.from_numpy(plate / 255).float()
            errors.append((shown - torch.from_numpy(self.capture.image(name, frame) / 255).float()).square().mean())
        return float(-10 * torch.log10(torch.stack(errors).mean()))


def learn(folder: Path, settings: TrainingSettings, bends_rad: tuple[float, float, float]) -> Learned:
    """Train on the column, bent by the first two angles; the third angle is a novel pose."""
    capture, masks, body = record(folder / "capture", bends_rad)
    (folder / "out").mkdir()
    train(capture, masks, body, settings, folder / "out", ALONE)
    return Learned(capture, body, load_avatar(folder / "out", "cpu"))


def three_poses() -> BodyFit:
    """Return the column as a fit of three frames: upright, and bent by 0.3 and 0.6 rad."""
    theta = torch.zeros(3, 2, 3)
    theta[:, 1, 1] = torch.tensor([0.0, 0.3, 0.6])
    return BodyFit(box_rig(bend_segments=6, splits=2), (0, 1, 2), theta, torch.eye(4).repeat(3, 1, 1))

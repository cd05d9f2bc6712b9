"""Add a compared method: NeRF with a voxel grid in place of its two networks, trained by the trainer of all methods.

`subject` is what examples/train.py wrote; its first frame is trained on. For a method to keep, see CONTRIBUTING.md."""

import argparse
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

from torch import nn, ones, stack

from hnerf.avatar.finished import recording_of
from hnerf.baselines.nerf import NerfField
from hnerf.body.fit_result import BodyFit
from hnerf.capture.masks import Masks
from hnerf.config import NerfSettings, load_settings
from hnerf.fields.sparse_grids import SparseGrids
from hnerf.training import trainer


class Voxels(nn.Module):
    def __init__(self):
        super().__init__()
        self.grid = SparseGrids(-ones(3), ones(3), (64,), 4, near=lambda points, _: ones(len(points), dtype=bool))

    def forward(self, point, view):
        density, *rgb = self.grid(point.reshape(-1, 3)).unflatten(0, point.shape[:-1]).unbind(-1)
        return 10 * nn.functional.softplus(density), stack(rgb, -1).sigmoid()


class VoxelField(NerfField):
    def __init__(self, body):
        super().__init__(body, NerfSettings(learning_rate=0.1))
        self.coarse, self.fine = Voxels(), Voxels()


def main(subject, out, overrides=()):
    capture = recording_of(subject)
    capture = replace(capture, train_frames=capture.train_frames[:1])
    masks, body = Masks.load(subject / "segmentation"), BodyFit.load(subject / "fit")
    with patch.object(trainer, "build_field", lambda settings, body, static: VoxelField(body)):
        return trainer.train(capture, masks, body, load_settings("nerf", overrides).training, out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    for folder in ("subject", "out"):
        parser.add_argument(folder, type=Path)
    print(main(**vars(parser.parse_args())))

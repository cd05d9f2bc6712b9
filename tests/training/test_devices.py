"""Devices: no operation mixes tensors of two devices, from the body to an image. The tests use a GPU if there is one,
and a simulated one otherwise."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from hnerf.avatar.surface import surface_in_pose
from hnerf.avatar.trained import load_avatar
from hnerf.render.pictures import depth_image, normal_image
from hnerf.training.distributed import Distributed
from hnerf.training.trainer import train
from tests.training.pretended_gpu import pretended_gpu
from tests.training.scene import record, tiny

WITH_GPU = torch.cuda.is_available()


@pytest.mark.usefixtures("any_surface")
@pytest.mark.parametrize("kind", ["fast", "paper", "nerf", "idr", "nerfies"])
def test_trains_loads_and_renders_on_one_device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str):
    capture, masks, body = record(tmp_path / "capture")
    camera = capture.cameras[capture.train_cameras[0]].scaled(0.5)
    changes: dict[str, object] = {"one_posture": False, "steps": 2, "novel_pose_steps": 1, "rays_per_frame": 16}
    if kind not in ("fast", "paper"):
        changes["pose_learning_rate"] = 0.0
    if kind in ("nerf", "idr"):
        capture = replace(capture, train_frames=capture.train_frames[:1])
    gpu = nullcontext(torch.device("cuda", 0)) if WITH_GPU else pretended_gpu(monkeypatch)
    with gpu as device:
        train(capture, masks, body, tiny(kind, **changes), tmp_path, Distributed(0, 1, device))
        avatar = load_avatar(tmp_path, device)
        theta, root = avatar.body.theta[0], avatar.body.root[0]
        shown = avatar.render(camera, theta, root)
        assert shown.rgb.device == device
        assert depth_image(shown, camera).shape == normal_image(avatar, shown, camera, theta, root).shape[:2]
        if kind == "fast":  # the others have no surface yet
            assert surface_in_pose(avatar, theta, root, 32).is_watertight
        assert avatar.colour(avatar.body.rig.vertices_m, avatar.body.rig.vertices_m, theta, root).device == device

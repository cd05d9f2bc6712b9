"""Untrained subjects: files of other versions, construction and rendering."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from hnerf.avatar import avatar as model
from hnerf.avatar.avatar import Avatar
from hnerf.avatar.finished import reason_without_novel_poses
from hnerf.avatar.model_file import write_field
from hnerf.avatar.trained import build_field, load_avatar
from hnerf.body.fit_result import BodyFit
from hnerf.config import TrainingSettings
from hnerf.errors import InputError
from hnerf.fields.paper import PaperField
from hnerf.fields.rays import PosedScene, Rays
from tests.body.boxes import box_rig
from tests.training.scene import TINY, record


@pytest.fixture
def subject(tmp_path: Path) -> Path:
    body = record(tmp_path / "capture")[2]
    body.save(tmp_path)
    write_field(build_field(TINY.field, body, False), tmp_path / "model.safetensors")
    (tmp_path / "settings.json").write_text(json.dumps({"static": False, "training": TINY.model_dump()}))
    return tmp_path


@pytest.mark.parametrize(
    "stored",
    [
        {"static": False, "training": TINY.model_dump() | {"momentum": 1}},
        {"static": False},
        {"training": TINY.model_dump()},
    ],
)
def test_other_settings_are_refused(subject: Path, stored: dict[str, object]):
    (subject / "settings.json").write_text(json.dumps(stored))
    for read in (load_avatar, reason_without_novel_poses):
        with pytest.raises(InputError, match=r"settings\.json: written by another version; train the subject again$"):
            read(subject)


def test_a_field_without_its_body_is_refused(subject: Path):
    path = subject / "model.safetensors"
    load_avatar(subject)
    save_file({name: tensor for name, tensor in load_file(path).items() if name != "canonical_m"}, path)
    with pytest.raises(InputError, match=r"model\.safetensors: written by another version; train the subject again$"):
        load_avatar(subject)


@pytest.mark.parametrize("bf16", [False, True])
def test_both_networks_of_the_paper_use_the_bf16_setting(tmp_path: Path, bf16: bool) -> None:
    changes = {"field": {"kind": "paper", "bf16": bf16}}
    field = build_field(TrainingSettings.model_validate(changes).field, record(tmp_path)[2], False)
    assert isinstance(field, PaperField)
    assert field.radiance.trunk.bf16 is field.residual.trunk.bf16 is bf16


def test_ray_batches_are_limited_by_their_number_of_samples(subject: Path, monkeypatch: pytest.MonkeyPatch):
    """Rays have at most 64 samples, and a batch may have 16384 samples."""
    capture, _, body = record(subject / "capture")
    avatar, at_once = load_avatar(subject, "cpu"), []
    look = avatar.field.render_rays

    def counted(scene: PosedScene[object], rays: Rays) -> Tensor:
        at_once.append(len(rays))
        return look(scene, rays)

    monkeypatch.setattr(avatar.field, "render_rays", counted)
    monkeypatch.setattr(model, "SAMPLES_PER_BATCH", 16384)
    avatar.render(capture.cameras["0"], body.theta[0], body.root[0])
    assert len(at_once) > 1 and at_once[0] == max(at_once) == 256


def test_fields_know_the_angle_of_a_pixel(subject: Path, monkeypatch: pytest.MonkeyPatch):
    """Twice the resolution halves it."""
    capture, _, body = record(subject / "capture")
    avatar, pixels_rad = load_avatar(subject, "cpu"), []

    def noted(scene: PosedScene[object], rays: Rays) -> Tensor:
        pixels_rad.append(scene.pixel_rad)
        return torch.zeros(len(rays), 5)

    monkeypatch.setattr(avatar.field, "render_rays", noted)
    camera = capture.cameras["0"]
    for seen in (camera, camera.scaled(2)):
        avatar.render(seen, body.theta[0], body.root[0])
    assert pixels_rad[0] == pytest.approx(1 / camera.K[0, 0])
    assert pixels_rad[-1] == pytest.approx(pixels_rad[0] / 2, rel=0.05)


def test_of_frames_in_the_same_pose_the_one_nearest_in_position_is_used():
    """Two frames have the same joint angles and are 1 m apart. A place 40 cm from the first is nearer to it."""
    theta, root = torch.zeros(2, 2, 3), torch.eye(4).repeat(2, 1, 1)
    root[1, 0, 3] = 1.0
    body = BodyFit(box_rig(), (0, 1), theta, root)
    avatar = Avatar(build_field(TINY.field, body, False), body, body)
    between = root[0].clone()
    between[0, 3] = 0.4
    assert [avatar._frame_row(theta[0], place).item() for place in (*root, between)] == [0, 1, 0]

"""The inputs that the trainer passes to a step: pixels, noise and bodies."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from hnerf.fields.conditions import Draws
from hnerf.fields.rays import PosedScene
from hnerf.training import trainer as trainer_module
from hnerf.training.auto_settings import Decision
from hnerf.training.pixels import PixelRays
from hnerf.training.trainer import Trainer
from tests.training.scene import ALONE, TINY, record, tiny

H_NERF = pytest.mark.parametrize("kind", ["fast", "paper"])


class RecordingObjective(torch.nn.Module):
    """A stand-in for the objective that keeps its arguments, for any number of parts."""

    def __init__(self, trainer: Trainer):
        super().__init__()
        self.trainer, self.parts = trainer, []

    def forward(self, scene: PosedScene[Any], rays: PixelRays, draws: Draws) -> tuple[dict[str, Tensor], Tensor]:
        self.parts.append((rays, scene.conditions, draws))
        nothing = sum(p.sum() for p in self.trainer.objective.parameters() if p.requires_grad) * 0.0
        return {"nothing": nothing}, torch.zeros(len(rays))

    def all(self, part: int, name: str) -> Tensor:
        """Return the tensor of this name from the rays (0) or draws (2) of all parts."""
        return torch.cat([getattr(handed[part], name) for handed in self.parts])


def trainer_of(folder: Path, cameras: tuple[str, ...] = ("0", "1", "2", "3"), **changes: Any) -> Trainer:
    capture, masks, body = record(folder / "capture")
    capture = dataclasses.replace(capture, train_cameras=cameras)
    return Trainer(capture, masks, body, tiny(**changes), folder, ALONE)


def step_inputs(trainer: Trainer) -> RecordingObjective:
    listener = RecordingObjective(trainer)
    trainer._optimise(listener)
    return listener


@H_NERF
def test_noise_reaches_the_networks(tmp_path: Path, kind: str) -> None:
    """Noise of 0.1 on theta, T and v: root mean squares over the 9, 36 and 384 numbers that are drawn."""
    trainer = trainer_of(tmp_path, kind=kind)
    listener = step_inputs(trainer)
    for _, conditions, _ in listener.parts:
        for noise, least, most in (
            (conditions.pose - trainer.scene.conditions.pose, 0.03, 0.25),
            (conditions.root - trainer.scene.conditions.root, 0.07, 0.13),
        ):
            assert least < noise.square().mean().sqrt() < most
            assert (noise != 0).all()
    view = listener.all(2, "view")
    assert view.shape == (128, 3) and 0.09 < view.square().mean().sqrt() < 0.11


def test_there_is_no_noise_if_it_is_set_to_zero(tmp_path: Path) -> None:
    trainer = trainer_of(tmp_path, noise=0.0)
    listener = step_inputs(trainer)
    for _, conditions, _ in listener.parts:
        assert torch.equal(conditions.pose, trainer.scene.conditions.pose)
        assert torch.equal(conditions.root, trainer.scene.conditions.root)
    assert not listener.all(2, "view").any()


def test_frames_of_novel_poses_are_not_trained_on(tmp_path: Path) -> None:
    """Rows 0 and 1 are drawn while the field is trained, row 2 only once it is finished."""
    trainer = trainer_of(tmp_path)
    assert step_inputs(trainer).all(0, "frame").unique().tolist() == [0, 1]
    trainer.step = trainer.field_steps
    assert step_inputs(trainer).all(0, "frame").unique().tolist() == [2]


def test_only_novel_frames_are_fitted_to_a_finished_field(tmp_path: Path) -> None:
    """Only the pose and the displacement of novel frames change: neither the field, nor training frames, nor the shape,
    although a loss acts on all of them."""
    trainer = trainer_of(tmp_path, losses=TINY.losses.model_copy(update={"increment": 1.0}))
    with torch.no_grad():
        for parameter in trainer.objective.correction.parameters():
            parameter.fill_(1e-3)
    before = {name: p.detach().clone() for name, p in trainer.objective.named_parameters()}
    trainer.step = trainer.field_steps
    trainer._freeze_field()
    trainer._optimise(trainer.objective)
    moved = {name: p != before[name] for name, p in trainer.objective.named_parameters()}
    of_frames = {f"correction.{name}" for name in ("turn", "move_m")} | {"field.deformation.displacement"}
    assert {name for name, changed in moved.items() if changed.any()} == of_frames
    for name in of_frames:
        assert not moved[name][[0, 1, *range(3, len(moved[name]))]].any()


def test_rates_rise_for_20_steps_and_fall_to_a_tenth(tmp_path: Path) -> None:
    """In both phases: 1/20 of 10^0 at the first step, 10/20 of 10^-0.09 at the tenth, 10^-0.99 at the last."""
    trainer = trainer_of(tmp_path, steps=100, novel_pose_steps=100)
    assert trainer.first_rates == [0.05, 0.01, 0.05, 0.001, 0.0005]
    for start in (0, 100):
        for step, factor in ((0, 1 / 20), (9, 0.5 * 10**-0.09), (50, 10**-0.5), (99, 10**-0.99)):
            trainer.step = start + step
            trainer._set_rates()
            rates = [group["lr"] for group in trainer.optimizer.param_groups]
            assert rates == pytest.approx([factor * rate for rate in trainer.first_rates])


def test_exposure_is_corrected_before_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Camera 2 shows red twice as bright as the others, and blue half as bright. The person is (200, 50, 50) in front
    of a plate of 128."""
    gains = dict.fromkeys("0123", (1.0, 1.0, 1.0)) | {"2": (2.0, 1.0, 0.5)}
    monkeypatch.setattr(trainer_module, "camera_gains", lambda *inputs: (gains, Decision(2.0, "twice as bright")))
    handed = step_inputs(trainer_of(tmp_path, rays_per_frame=512))
    colour, plate, person, edge = (handed.all(0, name) for name in ("colour", "plate", "person", "edge"))
    bright = handed.all(0, "origins_m")[:, 0] < -3  # camera 2 stands at x = -3.5 m
    for camera, red, grey in ((bright, [100, 50, 100], [64, 128, 255]), (~bright, [200, 50, 50], [128, 128, 128])):
        assert (255 * colour[camera & person]).round().unique(dim=0).tolist() == [red]
        assert (255 * plate[camera & ~edge]).round().unique(dim=0).tolist() == [grey]


def test_the_shell_is_tightened_at_each_absorption_until_the_field_is_finished(tmp_path: Path) -> None:
    """The shell starts at 20 cm. The untrained surface is the skin, whose logistic of 100 per metre saturates 5 cm from
    it; with a margin of 1.2 cm, the shell shrinks to 6.2 cm. Rays are then sampled in the new region."""
    trainer = trainer_of(tmp_path, absorb_steps=1)
    cells = (trainer.scene.region.cells == 1).sum()
    trainer.step = trainer.field_steps + 1
    trainer._absorb()
    assert trainer.field.outer_m.max().item() == pytest.approx(0.2)
    trainer.step = 1
    trainer._absorb()
    assert trainer.field.outer_m.max().item() == pytest.approx(0.062, abs=0.004)
    assert trainer.field.inner_m.max().item() == pytest.approx(0.062, abs=0.004)
    assert (trainer.scene.region.cells == 1).sum() < 0.7 * cells


@pytest.mark.usefixtures("any_surface")
@H_NERF
def test_bodies_absorb_the_learned_corrections(tmp_path: Path, kind: str) -> None:
    """Once a bend of 0.1 and a move of 1 cm are absorbed, the conditions include them and the correction is zero.
    `fast` moves the part that both training frames share, half, to the rest body; the novel frame does not change."""
    common = 0.5 if kind == "fast" else 0.0
    trainer = trainer_of(tmp_path, kind=kind)
    before = trainer.scene.conditions
    with torch.no_grad():
        trainer.objective.correction.turn[1, 0, 1] = 0.1
        trainer.objective.correction.move_m[0, 2] = 0.01
    trainer.step = 1
    trainer._absorb()
    after = trainer.scene.conditions
    assert (after.pose - before.pose)[:, 1].tolist() == pytest.approx([-0.1 * common, 0.1 * (1 - common), 0], abs=1e-6)
    moved_m = [0.01 * (1 - common), -0.01 * common, 0]
    assert (2.5 * (after.root - before.root)[:, 11]).tolist() == pytest.approx(moved_m, abs=1e-5)
    assert not any(p.any() for p in trainer.objective.correction.parameters())
    assert trainer.scene.bodies.root[0, :3, 3].tolist() == pytest.approx([0, 0, moved_m[0]], abs=1e-5)


@pytest.mark.usefixtures("any_surface")
def test_the_change_of_a_single_training_frame_stays_in_its_pose(tmp_path: Path) -> None:
    """The rest body would pass it on to poses of other frames, which it does not concern."""
    capture, masks, body = record(tmp_path / "capture")
    capture = dataclasses.replace(capture, train_frames=capture.train_frames[:1])
    trainer = Trainer(capture, masks, body, tiny(), tmp_path, ALONE)
    before = trainer.scene.conditions.pose
    with torch.no_grad():
        trainer.objective.correction.turn[0, 0, 1] = 0.1
    trainer.step = 1
    trainer._absorb()
    assert (trainer.scene.conditions.pose - before)[:, 1].tolist() == pytest.approx([0.1, 0, 0], abs=1e-6)
    torch.testing.assert_close(trainer.scene.bodies.rig.vertices_m, body.rig.vertices_m)


@pytest.mark.usefixtures("any_surface")
@H_NERF
def test_with_one_camera_the_mean_distance_of_the_fit_is_kept(tmp_path: Path, kind: str) -> None:
    """Two bodies stand at the origin, at a distance L from the camera at c. The first learns to stand at 1.1 L: the
    mean is 1.05 L, so both distances are scaled by 1 / 1.05, to positions -c / 21 and c / 21. The novel frame keeps its
    own move: it is fitted to the finished field later."""
    trainer = trainer_of(tmp_path, ("0",), kind=kind)
    centre_m = torch.tensor([4.5, 0.5, 1.5])  # of camera 0
    with torch.no_grad():
        trainer.objective.correction.move_m[0] = -0.1 * centre_m
        trainer.objective.correction.move_m[2] = -0.2 * centre_m
    trainer.step = 1
    trainer._absorb()
    stands_m = trainer.scene.bodies.root[:, :3, 3]
    expected_m = torch.stack([-centre_m / 21, centre_m / 21, -0.2 * centre_m])
    assert torch.allclose(stands_m, expected_m, atol=1e-5)
    assert torch.allclose(2.5 * trainer.scene.conditions.root[:, 3::4], expected_m, atol=1e-5)


def test_with_several_cameras_bodies_may_change_their_distance(tmp_path: Path) -> None:
    """With two cameras, a body that learns to stand a metre farther away stays there."""
    trainer = trainer_of(tmp_path, ("0", "1"), kind="paper")
    with torch.no_grad():
        trainer.objective.correction.move_m[0, 0] = -1.0
    trainer.step = 1
    trainer._absorb()
    assert trainer.scene.bodies.root[0, :3, 3].tolist() == pytest.approx([-1, 0, 0], abs=1e-5)


def test_the_ground_axis_is_the_vertical_axis_of_the_recording(tmp_path: Path) -> None:
    assert trainer_of(tmp_path / "known", ground=True).objective.ground_axis == 2
    assert trainer_of(tmp_path / "unknown", ground=False).objective.ground_axis is None

import json
import math
import os
import re
import resource
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch
from safetensors.torch import load_file

from hnerf.avatar.antialiasing import mixed_pixels
from hnerf.avatar.trained import load_avatar
from hnerf.body.canonical import axis_angle_from_rotation
from hnerf.body.rig import rotation_from_axis_angle
from hnerf.config import TrainingSettings, load_settings
from hnerf.training import trainer as trainer_module
from hnerf.training.checkpoint import NAME, load_checkpoint, save_checkpoint, training_key
from hnerf.training.pixels import PixelRays, Pixels
from hnerf.training.step import TrainingError
from hnerf.training.trainer import Trainer, train
from tests.training.scene import ALONE, FRAMES, TINY, TINY_FIELDS, record, tiny

pytestmark = pytest.mark.usefixtures("any_surface")


@pytest.mark.parametrize("kind", ["fast", "paper"])
def test_an_interrupted_training_ends_like_an_uninterrupted_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
):
    """A training interrupted after five steps resumes from the checkpoint at three. It ends with the same weights,
    poses and losses, bit by bit."""
    recording = record(tmp_path / "capture")
    few = {"steps": 6, "novel_pose_steps": 2, "absorb_steps": 2, "checkpoint_steps": 3}
    settings = tiny(kind, rays_per_frame=16, **few)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    whole.mkdir()
    optimise = Trainer._optimise

    def keep_at_five(self, module):
        if self.step == 5 and not parts.exists():
            shutil.copytree(whole, parts)
        return optimise(self, module)

    monkeypatch.setattr(Trainer, "_optimise", keep_at_five)
    train(*recording, settings, whole, ALONE)
    assert (parts / NAME).exists() and not (parts / "model.safetensors").exists()
    train(*recording, settings, parts, ALONE)

    one, two = (load_file(folder / "model.safetensors") for folder in (whole, parts))
    assert all(torch.equal(one[name], two[name]) for name in one)
    bodies = [load_avatar(folder, "cpu").body for folder in (whole, parts)]
    assert torch.equal(bodies[0].theta, bodies[1].theta)
    losses = [
        [json.loads(row)["losses"] for row in (f / "history.jsonl").read_text().splitlines()] for f in (whole, parts)
    ]
    assert losses[0] == losses[1]


@pytest.mark.parametrize("novel_pose_steps", [0, 1])
def test_a_training_stopped_after_its_last_step_only_writes_its_files_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, novel_pose_steps: int
) -> None:
    recording, settings = record(tmp_path / "capture"), tiny(steps=2, novel_pose_steps=novel_pose_steps)
    first = train(*recording, settings, tmp_path, ALONE)
    written = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    monkeypatch.delattr(Trainer, "_optimise")  # no step is taken
    again = train(*recording, settings, tmp_path, ALONE)
    assert again["steps"] == first["steps"] == 2 + novel_pose_steps
    kept = {name for name, content in written.items() if (tmp_path / name).read_bytes() == content}
    assert written.keys() - kept <= {"report.json"}  # the setup took a different time


def test_a_field_can_overfit_the_column(tmp_path: Path):
    """After a few seconds of training, a rendered training view has more than 40 dB and the right depth. Outlines are
    left out, because those of the photograph are not antialiased."""
    capture, masks, body = record(tmp_path / "capture")
    rates = {"network_learning_rate": 0.03, "grid_learning_rate": 0.07}
    fast = TINY.field.model_dump() | rates | {"spacing_m": 0.015, "outer_m": 0.1}
    out = tmp_path / "out"
    out.mkdir()
    rare = {"absorb_steps": 40, "checkpoint_steps": 80}
    train(capture, masks, body, tiny(field=fast, steps=80, rays_per_frame=128, **rare), out, ALONE)
    avatar = load_avatar(out, "cpu")
    drawn = avatar.render(capture.cameras["0"], avatar.body.theta[0], avatar.body.root[0])
    mask = torch.from_numpy(masks.get("0", 0))
    wanted = torch.from_numpy(capture.image("0", 0)) / 255 * mask[..., None]
    away = ~mixed_pixels(mask[..., None].float())
    assert -10 * torch.log10(((drawn.rgb - wanted)[away] ** 2).mean()) > 40
    assert drawn.depth_m[mask].mean().item() == pytest.approx(3.6, abs=0.4)


def test_the_paper_preset_reduces_its_nine_losses_and_fog(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With the weights of the preset, on the same batch in every step, so that random batches do not hide progress."""
    losses = load_settings("paper").training.losses
    few = {"steps": 15, "novel_pose_steps": 0, "rays_per_frame": 32}
    settings = tiny(field={"kind": "paper", "samples": 16}, losses=losses, **few)
    trainer = Trainer(*record(tmp_path / "capture"), settings, tmp_path, ALONE)

    def optimise_the_same(module: torch.nn.Module) -> dict[str, torch.Tensor]:
        trainer.generator.manual_seed(0)
        return Trainer._optimise(trainer, module)

    monkeypatch.setattr(trainer, "_optimise", optimise_the_same)
    monkeypatch.setattr(trainer_module, "WARM_UP_STEPS", 1)
    trainer.run()
    first, last = (trainer.history[k]["losses"] for k in (0, -1))
    colour, shape = {"reconstruction", "mask", "fog", "blend"}, {"geometry", "segmentation", "eikonal"}
    assert first.keys() == last.keys() == colour | shape | {"residual", "fit", "increment"}
    assert all(math.isfinite(value) and value > 0 for value in last.values())
    assert sum(last.values()) < 0.95 * sum(first.values())


def test_a_model_loads_after_the_shape_has_changed(tmp_path: Path):
    """The extent of the grids comes from the body before its shape was tuned, also in the loaded avatar."""
    trainer = Trainer(*record(tmp_path / "capture"), tiny(steps=2, novel_pose_steps=0), tmp_path, ALONE)
    with torch.no_grad():
        trainer.objective.correction.shape += 0.2  # 20 cm taller
    trainer.run()
    avatar = load_avatar(tmp_path, "cpu")
    assert avatar.body.rig.vertices_m[:, 2].max().item() == pytest.approx(2.2, abs=0.02)
    for (name, loaded), learned in zip(avatar.field.named_parameters(), trainer.field.parameters(), strict=True):
        within = learned.abs().max().item() / 253 if name.endswith("features") else 0.0  # half a step of a stored grid
        torch.testing.assert_close(loaded, learned, rtol=0, atol=within, msg=name)


def test_a_time_limit_ends_the_field_and_lowers_learning_rates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With steps of 0.25 s, a limit of one second ends the field after four of them, when learning rates have fallen to
    a tenth. Novel poses still get their four steps."""
    trainer = Trainer(*record(tmp_path / "capture"), tiny(seconds=1.0, steps=1000), tmp_path, ALONE)
    monkeypatch.setattr(trainer_module, "WARM_UP_STEPS", 1)
    now_s = 0.0

    def optimise_in_a_quarter(module: torch.nn.Module) -> dict[str, torch.Tensor]:
        nonlocal now_s
        now_s += 0.25
        return Trainer._optimise(trainer, module)

    monkeypatch.setattr(trainer, "_optimise", optimise_in_a_quarter)
    monkeypatch.setattr(trainer_module.time, "monotonic", lambda: now_s)
    trainer.run()
    assert (trainer.field_steps, trainer.step) == (4, 8)
    trainer.step, trainer.seconds, trainer.field_steps = 4, 1.0, 1000
    trainer._set_rates()
    assert trainer.optimizer.param_groups[0]["lr"] == pytest.approx(0.1 * trainer.first_rates[0])


def test_a_snapshot_can_be_loaded_and_rendered(tmp_path: Path):
    """Two that are due after the same step are the same."""
    capture, masks, body = record(tmp_path / "capture")
    Trainer(capture, masks, body, tiny(snapshots_s=[1e-6, 2e-6], steps=2, novel_pose_steps=0), tmp_path, ALONE).run()
    folders = (tmp_path / "snapshots" / "1e-06", tmp_path / "snapshots" / "2e-06", tmp_path)
    early, other, late = (load_avatar(folder, "cpu") for folder in folders)
    assert early.field.log_sharpness == other.field.log_sharpness != late.field.log_sharpness
    assert early.render(capture.cameras["0"], early.body.theta[0], early.body.root[0]).alpha.max() > 0.5


def test_a_checkpoint_without_its_earlier_snapshots_is_discarded(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The snapshots may be on another machine. Those that are not due yet may be missing."""
    recording, snapshot = record(tmp_path / "capture"), tmp_path / "snapshots"
    settings = tiny(snapshots_s=[1e-6, 1e6], steps=2, novel_pose_steps=0)
    train(*recording, settings, tmp_path, ALONE)
    train(*recording, settings, tmp_path, ALONE)
    assert "starts again" not in caplog.text
    snapshot.rename(tmp_path / "elsewhere")
    train(*recording, settings, tmp_path, ALONE)
    assert "snapshots/1e-06: not there, though the checkpoint is later; the training starts again" in caplog.text
    assert [path.name for path in snapshot.iterdir()] == ["1e-06"]


def test_novel_poses_never_train_the_field(tmp_path: Path):
    """The field learns only from training frames: without the second phase, or with it and other colours in the novel
    frame, it is the same to the bit. Training poses and deformations stay, too, although the optimiser has momentum;
    those of the novel frame change."""
    models = []
    for steps in (0, 4):
        out = tmp_path / f"{steps}"
        capture, masks, body = record(out / "capture")
        if steps:
            for path in (out / "capture" / "images").glob(f"*/{FRAMES[2]:06d}.png"):
                assert cv2.imwrite(str(path), 255 - cv2.imread(str(path)))
        train(capture, masks, body, tiny(steps=6, novel_pose_steps=steps), out, ALONE)
        models.append(load_file(out / "model.safetensors"))
    deformations = [model.pop("deformation.displacement") for model in models]
    assert all(torch.equal(models[0][name], models[1][name]) for name in models[0])
    assert torch.equal(deformations[0][[0, 1, 3]], deformations[1][[0, 1, 3]])
    assert (deformations[0][2] != deformations[1][2]).any()
    still, fitted = (load_avatar(tmp_path / f"{steps}", "cpu").body for steps in (0, 4))
    torch.testing.assert_close(fitted.theta[:2], still.theta[:2], atol=1e-6, rtol=0)
    torch.testing.assert_close(fitted.root[:2], still.root[:2], atol=1e-6, rtol=0)
    assert (fitted.theta[2] - still.theta[2]).abs().max() > 2e-5


def test_training_frames_with_one_posture_keep_one(tmp_path: Path):
    """Joint angles change equally in all training frames; roots and the novel frame change independently."""
    capture, masks, body = record(tmp_path / "capture")
    rows = [body.index(frame) for frame in capture.train_frames]
    body.theta[rows] = body.theta[rows].mean(0)
    train(capture, masks, body, tiny(one_posture=True, novel_pose_steps=4), tmp_path, ALONE)
    tuned = load_avatar(tmp_path, "cpu").body
    turn = tuned.theta - body.theta
    assert turn[rows].abs().max() > 1e-4
    torch.testing.assert_close(tuned.theta[rows], tuned.theta[rows[:1]].expand(len(rows), -1, -1), atol=1e-6, rtol=0)
    assert (turn[2] - turn[0]).abs().max() > 2e-5
    assert (tuned.root[rows[0]] - body.root[rows[0]] - tuned.root[rows[1]] + body.root[rows[1]]).abs().max() > 1e-5


@pytest.mark.parametrize(("kind", "common"), [("fast", True), ("paper", False)])
def test_the_common_change_of_all_poses_moves_to_the_rest_body(tmp_path: Path, kind: str, common: bool):
    """Training poses then have a mean change of zero. A novel pose gets the common change through the rest body: its
    theta stays as fitted, while the vertices of the rest body move. The published method does not change its rest
    body."""
    capture, masks, body = record(tmp_path / "capture")
    settings = tiny(kind, pose_learning_rate=0.01, novel_pose_steps=0)
    trainer = Trainer(capture, masks, body, settings, tmp_path, ALONE)
    trainer.run()
    tuned, rows = trainer.scene.bodies, trainer.train_rows
    fitted, trained = (rotation_from_axis_angle(theta[rows]) for theta in (body.theta, tuned.theta))
    turn = axis_angle_from_rotation(fitted.mT @ trained)  # about the joints' own axes
    assert turn.abs().max() > 1e-3
    assert (turn.mean(0).abs().max() < 1e-4) == common
    torch.testing.assert_close(tuned.theta[2], body.theta[2], atol=1e-6, rtol=0)
    reshaped = body.rig.reshaped(tuned.rig.beta)
    moved_m = (tuned.rig.vertices_m - reshaped.vertices_m).abs().max()
    assert moved_m > 1e-3 if common else moved_m < 1e-6
    if common:
        displacement = load_file(tmp_path / "model.safetensors")["deformation.displacement"]
        torch.testing.assert_close(displacement[-1], displacement[rows].mean(0))
        assert displacement[-1].abs().max() > 0


def test_with_a_single_training_frame_there_is_no_deformation(tmp_path: Path):
    """The poses of novel frames are still fitted."""
    capture, masks, body = record(tmp_path / "capture")
    train(replace(capture, train_frames=FRAMES[:1]), masks, body, tiny(novel_pose_steps=8), tmp_path, ALONE)
    assert not any("deformation" in name for name in load_file(tmp_path / "model.safetensors"))
    assert (load_avatar(tmp_path, "cpu").body.theta[2] - body.theta[2]).abs().max() > 2e-5


def test_nan_losses_stop_the_run_with_their_cause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    trainer = Trainer(*record(tmp_path / "capture"), TINY, tmp_path, ALONE)
    before = {name: p.clone() for name, p in trainer.field.named_parameters()}
    poisoned = trainer.objective.forward

    def poison(*arguments):
        terms, errors = poisoned(*arguments)
        return {name: value * float("nan") for name, value in terms.items()}, errors

    monkeypatch.setattr(trainer.objective, "forward", poison)
    with pytest.raises(TrainingError, match=r"reconstruction.*not finite.*3 times in a row"):
        trainer.run()
    assert all(torch.equal(before[name], p) for name, p in trainer.field.named_parameters())
    first = next(record.getMessage() for record in caplog.records if record.levelname == "WARNING")
    assert re.fullmatch(r"step 0: reconstruction.* not finite: rays of frames [01], [01], seed 0: step skipped", first)


def test_a_gradient_that_is_not_finite_skips_the_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The gradient of a square root at zero is not finite, although its value is."""
    trainer = Trainer(*record(tmp_path / "capture"), TINY, tmp_path, ALONE)
    before = {name: p.clone() for name, p in trainer.field.named_parameters()}
    whole = trainer.objective.forward

    def rooted(*arguments):
        zero = sum(p.sum() for p in trainer.field.parameters()) * 0.0
        terms, errors = whole(*arguments)
        return terms | {"rooted": zero.sqrt()}, errors

    monkeypatch.setattr(trainer.objective, "forward", rooted)
    terms = trainer._optimise(trainer.objective)
    assert all(torch.isfinite(term) for term in terms.values())
    assert trainer.skipped == 1
    assert all(torch.equal(before[name], p) for name, p in trainer.field.named_parameters())


def test_held_out_frames_that_do_not_show_the_person_are_not_scored(tmp_path: Path):
    trainer = Trainer(*record(tmp_path / "capture"), tiny(), tmp_path, ALONE)
    trainer.step = trainer.field_steps
    trainer._record({})
    trainer.pixels.person[:] = False
    trainer._record({})
    assert ["held_out" in row for row in trainer.history] == [True, False]


def test_the_curve_has_a_point_at_every_hundred_steps(tmp_path: Path):
    trainer = Trainer(*record(tmp_path / "capture"), tiny(), tmp_path, ALONE)
    trainer.field_steps = 250
    for step in (1, 25, 100, 125, 250, 275):
        trainer.step = step
        trainer._record({})
    assert ["held_out" in row for row in trainer.history] == [True, False, True, False, True, False]


def test_the_progress_message():
    row = {"step": 25, "seconds": 7.0, "losses": {"reconstruction": 0.1234, "elastic": 0.0}}
    assert trainer_module._progress_message(row) == "reconstruction 0.12"
    assert (
        trainer_module._progress_message(row | {"held_out": {"psnr": 17.06}})
        == "reconstruction 0.12, 17.1 dB on unseen frames"
    )


def test_a_checkpoint_is_replaced_atomically(tmp_path: Path):
    save_checkpoint(tmp_path, {"key": "mine", "step": 1, "x": torch.ones(2)})
    save_checkpoint(tmp_path, {"key": "mine", "step": 2, "x": torch.zeros(2)})
    assert [p.name for p in tmp_path.iterdir()] == [NAME]
    state = load_checkpoint(tmp_path, torch.device("cpu"), "mine")
    assert state is not None and state["step"] == 2


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_damaged_checkpoint_is_discarded_with_a_warning(
    share: float, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    save_checkpoint(tmp_path, {"key": "mine", "x": torch.ones(1000)})
    os.truncate(tmp_path / NAME, int(share * (tmp_path / NAME).stat().st_size))
    assert load_checkpoint(tmp_path, torch.device("cpu"), "mine") is None
    (warning,) = caplog.messages
    assert "checkpoint.pt: cannot be read" in warning and "\n" not in warning


def test_a_checkpoint_with_a_flipped_bit_is_discarded_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A disk or a bucket may return such a file; torch itself would read it without an error."""
    save_checkpoint(tmp_path, {"key": "mine", "x": torch.full((1000,), 1.25)})
    written = bytearray((tmp_path / NAME).read_bytes())
    written[written.index(torch.full((500,), 1.25).numpy().tobytes()) + 1003] ^= 0x40  # in the exponent of one weight
    (tmp_path / NAME).write_bytes(written)
    assert load_checkpoint(tmp_path, torch.device("cpu"), "mine") is None
    (warning,) = caplog.messages
    assert "checkpoint.pt: cannot be read (archive/data/0 has changed)" in warning and "\n" not in warning


def test_a_checkpoint_of_another_training_is_discarded(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save_checkpoint(tmp_path, {"key": "theirs", "step": 1})
    assert load_checkpoint(tmp_path, torch.device("cpu"), "mine") is None
    assert "checkpoint.pt: is of another training" in caplog.text


def test_other_settings_or_poses_have_another_training_key(tmp_path: Path) -> None:
    capture, masks, body = record(tmp_path / "capture")
    moved = replace(body, root=body.root + 1e-3)
    scenes = [(body, TINY), (body, TINY.model_copy(update={"seed": 1})), (moved, TINY)]
    keys = {training_key(capture, masks, used, settings) for used, settings in scenes}
    same = TINY.model_copy(update={"memory_gib": 8.0})
    assert len(keys) == 3 and training_key(capture, masks, body, same) in keys


def test_a_full_disk_is_an_os_error_and_leaves_no_partial_checkpoint(tmp_path: Path):
    """torch alone reports such a failure as a RuntimeError."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, limits[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            save_checkpoint(tmp_path, {"x": torch.ones(1 << 16)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []


def test_a_field_with_its_own_background_learns_from_every_pixel(tmp_path: Path):
    """The published method draws uniformly from all pixels, without plates; a composited field needs pixels near the
    person, more of them where its colours are wrong."""
    scene = record(tmp_path)
    height, width = scene[0].image("0", 0).shape[:2]
    images = len(scene[0].train_cameras) * len(scene[2].frames)
    in_box = TINY_FIELDS["paper"] | {"rays": "box"}
    for settings, whole, uniform in (
        (tiny("paper"), True, True),
        (tiny("paper", field=in_box), False, True),
        (tiny("fast"), False, False),
    ):
        trainer = Trainer(*scene, settings, tmp_path / "out", ALONE)
        assert (len(trainer.pixels.edge) == images * height * width) == whole
        assert (trainer.errors is None) == uniform
        assert (trainer.pixels.plate is None) == trainer.field.models_background


def test_the_number_of_rays_per_step_does_not_depend_on_the_number_of_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The settings request four frames of 64 rays, but there are only two training frames and one novel frame."""
    drawn = []
    draw = Pixels.draw

    def counted(self: Pixels, frames: torch.Tensor, rays_per_frame: int, *others: Any) -> PixelRays:
        drawn.append((len(frames), rays_per_frame))
        return draw(self, frames, rays_per_frame, *others)

    trainer = Trainer(*record(tmp_path / "capture"), tiny(frames_per_step=4), tmp_path, ALONE)
    monkeypatch.setattr(Pixels, "draw", counted)
    for step in (0, trainer.field_steps):
        trainer.step = step
        trainer._optimise(trainer.objective)
    assert drawn == [(2, 128), (1, 256)]


def test_progress_counts_steps_of_both_phases_or_time_if_that_is_ahead(caplog: pytest.LogCaptureFixture) -> None:
    trainer = Trainer.__new__(Trainer)
    trainer.settings = TrainingSettings(steps=10, seconds=20, novel_pose_steps=4)
    trainer.novel_rows = torch.zeros(1)
    with caplog.at_level("DEBUG", "hnerf.progress"):
        for trainer.step, trainer.seconds, trainer.field_steps in ((4, 2, 10), (5, 15, 10), (7, 20, 7), (9, 24, 7)):
            trainer._report_progress()
    assert [record.progress[1:] for record in caplog.records] == [(4, 14), (7.5, 14), (7, 11), (9, 11)]

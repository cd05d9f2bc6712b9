"""Training: first the field with the poses of the training frames; then the poses and deformations of novel frames,
against the finished field."""

import dataclasses
import json
import logging
import resource
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from hnerf.avatar.model_file import write_field
from hnerf.avatar.trained import build_field
from hnerf.body.canonical import PosedBodies
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.config import TrainingSettings
from hnerf.fields.conditions import Conditions, Draws
from hnerf.progress import report
from hnerf.results.files import write_result
from hnerf.results.training import TrainingReport
from hnerf.training.auto_settings import SceneStatistics, decide
from hnerf.training.checkpoint import load_checkpoint, save_checkpoint, training_key
from hnerf.training.distributed import Distributed
from hnerf.training.exposure import camera_gains
from hnerf.training.fixed_rays import FixedRays
from hnerf.training.gather import gather_pixels
from hnerf.training.parts import decide_parts
from hnerf.training.pixels import CellErrors
from hnerf.training.step import Objective, TrainingError, not_finite
from hnerf.training.tuned_poses import keep_distance, share_rest

logger = logging.getLogger("hnerf.training")

WARM_UP_STEPS = 20
FINAL_LEARNING_RATE = 0.1  # at the end, relative to the first
SKIPS_ALLOWED = 2  # consecutive; one more non-finite step stops the run
LOG_STEPS = 25
CURVE_STEPS = 100  # between the points of the curve on unseen frames, each of which takes as long as a step
TRIAL_FRAMES = 8  # at most, to measure the memory that rays need
POSE_STRIDE = 6  # between the training poses for which the shell is tightened


class Trainer:
    """State of one training; `run` continues from the checkpoint to the end."""

    def __init__(
        self,
        capture: Capture,
        masks: Masks,
        body: BodyFit,
        settings: TrainingSettings,
        out: Path,
        processes: Distributed,
    ):
        started_at = time.monotonic()
        self.key = training_key(capture, masks, body, settings)
        self.settings, self.decisions = decide(SceneStatistics.of(capture, masks, body), settings)
        settings, self.out, self.processes = self.settings, out, processes
        device = processes.device
        torch.manual_seed(settings.seed)
        self.generator = torch.Generator(device).manual_seed(settings.seed)
        self.static = len(capture.train_frames) == 1
        self.body = body.to(device)
        self.field = build_field(settings.field, self.body, self.static).to(device)
        if device.type == "cuda" and shutil.which("cc"):  # Triton needs a C compiler when it runs
            self.field.compile_networks()
        bodies = PosedBodies(self.body.rig, self.body.theta, self.body.root, self.field.canonical_m)
        ground_axis = "xyz".index(capture.up) if settings.ground else None
        self.objective = Objective(self.field, bodies.correction(), settings, ground_axis)
        poses = {"params": list(self.objective.correction.parameters()), "lr": settings.pose_learning_rate}
        groups = [*self.field.parameter_groups(), poses]
        self.optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-12, fused=True)
        self.first_rates = [group["lr"] for group in self.optimizer.param_groups]
        self.gains, self.decisions["gains"] = camera_gains(capture, masks, body)
        logger.info("gathering pixels")
        visible_pixels = None if self.field.whole_images else self.field.visible_pixels
        uniform = self.field.models_background  # as the paper draws
        self.pixels = gather_pixels(
            capture, masks, body, visible_pixels, self.gains, out, processes, with_plates=not uniform
        )
        cell = self.pixels.cell
        self.errors = None if uniform or cell is None else CellErrors(int(cell.max()) + 1)
        seen = self.pixels.starts.diff() > 0  # False where all masks of a frame were dropped
        rows = {frame: row for row, frame in enumerate(body.frames) if seen[row]}
        self.train_rows = torch.tensor([rows[f] for f in capture.train_frames if f in rows], device=device)
        held_out = [rows[f] for f in capture.novel_pose_frames if f in rows and f not in capture.train_frames]
        self.novel_rows = torch.tensor(held_out, dtype=torch.long, device=device)
        centres_m = [capture.cameras[name].centre_m for name in capture.train_cameras]
        self.only_centre_m = torch.as_tensor(centres_m[0]).to(self.body.root) if len(centres_m) == 1 else None
        self.step, self.skipped, self.seconds = 0, 0, 0.0
        self.field_steps, self.field_seconds = settings.steps, 0.0  # fewer steps if the time limit comes first
        self.history: list[dict[str, Any]] = []
        self._set_poses(bodies)
        rays = settings.frames_per_step * settings.rays_per_frame
        self.parts, self.decisions["parts"] = decide_parts(rays, settings.memory_gib, self._trial_loss, processes)
        self.fixed_rays = FixedRays(self.field, self.pixels, settings.seed, self.parts.most_rays)
        self._resume()
        self.setup_seconds = time.monotonic() - started_at

    @property
    def steps(self) -> int:
        """Return the number of steps of both phases."""
        learns = self.settings.pose_learning_rate > 0 or len(self.field.frame_parameters()) > 0
        return self.field_steps + (self.settings.novel_pose_steps if learns and len(self.novel_rows) else 0)

    def _set_poses(self, bodies: PosedBodies) -> None:
        """Use the bodies' current poses for the coming steps."""
        frame_rows = torch.arange(len(bodies.theta), device=bodies.theta.device)
        conditions = Conditions.of(bodies, frame_rows, self.settings.field.scene_m)
        self.scene = self.field.scene(bodies, conditions)

    def run(self) -> TrainingReport | None:
        """Train to the end and write the subject's files; return the report, None in a process that writes none."""
        module: torch.nn.Module = self.objective
        if self.processes.world_size > 1:
            devices = [self.processes.device] if self.processes.device.type == "cuda" else None
            module = DistributedDataParallel(self.objective, device_ids=devices, find_unused_parameters=True)
        started, last_log = time.monotonic() - self.seconds, time.monotonic()
        snapshots_s = [s for s in sorted(self.settings.snapshots_s) if s > self.seconds]
        while self.step < self.steps:
            if self.step == self.field_steps:
                self._freeze_field()
                self.optimizer.state.clear()  # its momentum would keep moving the training poses
            terms = self._optimise(module)
            self.step += 1
            if self.step < self.field_steps:
                self.field.on_progress(self._progress())
            self.seconds = self.processes.all_max(time.monotonic() - started)  # one clock: learning rates follow it
            if self.step < self.field_steps and self.settings.seconds and self.seconds >= self.settings.seconds:
                self.field_steps = self.step
            if self.step == self.field_steps:
                self.field_seconds = self.seconds
            if self.processes.is_main:
                self._report_progress()
            due_s = [s for s in snapshots_s if s <= self.seconds]
            checkpoint_due = self.step % self.settings.checkpoint_steps == 0 or self.step == self.steps
            absorb_due = self.step % self.settings.absorb_steps == 0 or self.step in (self.field_steps, self.steps)
            if absorb_due or due_s or checkpoint_due:  # a resumed training finds the same bodies
                self._absorb()
            if due_s:
                for s in due_s if self.processes.is_main else ():
                    self._save(self._snapshot(s))
                snapshots_s = snapshots_s[len(due_s) :]
                self.processes.barrier()
                started = time.monotonic() - self.seconds  # writing snapshots does not count
            if self.step % LOG_STEPS == 0 or self.step in (1, self.field_steps, self.steps):
                self._record(terms)
                if time.monotonic() - last_log > 5 and self.processes.is_main:
                    last_log = time.monotonic()
                    message = _progress_message(self.history[-1])
                    logger.info("step %d of %d, %.0f s: %s", self.step, self.steps, self.seconds, message)
            if checkpoint_due and self.processes.is_main:
                save_checkpoint(self.out, self._state())
        if self.processes.is_main:
            (self.out / "history.jsonl").write_text("".join(json.dumps(row) + "\n" for row in self.history))
        self.fixed_rays.require_surface(self.scene, self.train_rows)
        return self._finish() if self.processes.is_main else None

    def _absorb(self) -> None:
        self.scene.bodies.absorb(self.objective.correction, self.train_rows if self.settings.one_posture else None)
        if self.step <= self.field_steps:
            if self.only_centre_m is not None:
                keep_distance(self.scene.bodies, self.body, self.train_rows, self.only_centre_m)
            # What the training frames have in common applies to all poses; changes in the pose of a single frame, or in
            # a posture that all of them share, stay there.
            self.field.average_over_frames(self.train_rows)
            if self.field.common_rest and not self.settings.one_posture and len(self.train_rows) > 1:
                share_rest(self.scene.bodies, self.body, self.train_rows)
            self.field.tighten(self.scene.bodies.rig, self.scene.conditions.pose[self.train_rows[::POSE_STRIDE]])
        self._set_poses(self.scene.bodies)

    def _freeze_field(self) -> None:
        """Freeze the field; the parameters of novel frames are fitted to it, so that it never learns from their
        pixels."""
        self.field.requires_grad_(False)
        self.objective.correction.shape.requires_grad_(False)
        for parameter in self.field.frame_parameters():
            parameter.requires_grad_(True)

    def _optimise(self, module: torch.nn.Module) -> dict[str, Tensor]:
        s = self.settings
        rows = self.train_rows if self.step < self.field_steps else self.novel_rows
        pick = torch.randperm(len(rows), generator=self.generator, device=rows.device)[: s.frames_per_step]
        count = s.frames_per_step * s.rays_per_frame // len(pick)
        rays = self.pixels.draw(rows[pick], count, self.generator, self.errors)
        samples, spacing_m = self.field.training_samples(self._progress())
        draws = Draws.random(len(rays), samples, s.noise, self.generator, spacing_m)
        scene = self.scene.with_noise(s.noise, self.generator)
        self._set_rates()
        self.optimizer.zero_grad(set_to_none=True)
        terms, errors = self.parts.backward(module, scene, rays, draws, self.processes)
        if self.step >= self.field_steps:  # the loss that pulls all frames to the fit must not move finished frames
            for pose in (self.objective.correction.turn, self.objective.correction.move_m):
                if pose.grad is not None:
                    pose.grad[self.train_rows] = 0.0
        gradients = [q.grad for q in self.objective.parameters() if q.grad is not None]
        fault = not_finite(terms, gradients, self.step, self.processes)
        if fault is None:
            self.optimizer.step()
            if self.errors and rays.cell is not None:
                self.errors.update(rays.cell, errors.cpu())
            self.skipped = 0
        else:
            self.skipped += 1
            frames = ", ".join(str(self.body.frames[row]) for row in rows[pick].tolist())
            logger.warning("%s: rays of frames %s, seed %d: step skipped", fault, frames, s.seed)
            if self.skipped > SKIPS_ALLOWED:
                raise TrainingError(
                    f"{fault}, {self.skipped} times in a row; lower the learning rates or check the fit"
                )
        return terms

    def _trial_loss(self, about: int) -> tuple[int, Tensor]:
        """Return the number of rays, about `about`, and the loss of a batch as at the end of training, with the most
        samples that a ray can get. It does not consume the training's random numbers."""
        generator = torch.Generator(self.processes.device).manual_seed(self.settings.seed)
        rows, noise = self.train_rows[: self.settings.frames_per_step][:TRIAL_FRAMES], self.settings.noise
        rays = self.pixels.draw(rows, about // len(rows), generator)
        draws = Draws.random(len(rays), self.field.training_samples(1.0)[0], noise, generator)
        terms, _ = self.objective(self.scene.with_noise(noise, generator), rays, draws)
        return len(rays), torch.stack(list(terms.values())).sum()

    def _progress(self) -> float:
        """Return the progress of the phase, 0 to 1."""
        s = self.settings
        if self.step < self.field_steps:
            return max(self.step / s.steps, self.seconds / s.seconds if s.seconds else 0.0)
        return (self.step - self.field_steps) / s.novel_pose_steps

    def _report_progress(self) -> None:
        """Report the steps done in both phases, or as many as the time used amounts to if that is more."""
        done = self._progress() * self.field_steps if self.step < self.field_steps else self.step
        report("training", done, self.steps)

    def _set_rates(self) -> None:
        phase_step = self.step if self.step < self.field_steps else self.step - self.field_steps
        factor = FINAL_LEARNING_RATE ** self._progress() * min(1.0, (phase_step + 1) / WARM_UP_STEPS)
        for group, rate in zip(self.optimizer.param_groups, self.first_rates, strict=True):
            group["lr"] = rate * factor

    def _record(self, terms: dict[str, Tensor]) -> None:
        row: dict[str, Any] = {"step": self.step, "seconds": round(self.seconds, 2)}
        row["losses"] = {name: value.item() for name, value in terms.items()}
        on_curve = self.step % CURVE_STEPS == 0 or self.step in (1, self.field_steps)
        if len(self.novel_rows) and self.step <= self.field_steps and on_curve:
            psnr = self.fixed_rays.psnr(self.scene, self.novel_rows)
            row |= {"held_out": {"psnr": psnr}} if psnr is not None else {}
        self.history.append(row)

    def _state(self) -> dict[str, Any]:
        bodies = self.scene.bodies
        return {
            "key": self.key,
            "step": self.step,
            "skipped": self.skipped,
            "seconds": self.seconds,
            "field_steps": self.field_steps,
            "field_seconds": self.field_seconds,
            "objective": self.objective.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "generator": self.generator.get_state(),
            "theta": bodies.theta,
            "root": bodies.root,
            "errors": None if self.errors is None else self.errors.mean,
            "rig": {name: getattr(bodies.rig, name) for name in ("vertices_m", "joints_m", "beta")},
            "history": json.dumps(self.history),
        }

    def _resume(self) -> None:
        state = load_checkpoint(self.out, self.processes.device, self.key)
        if state is None or self._lacks_snapshots(state["seconds"]):
            return
        self.step, self.skipped, self.seconds = state["step"], state["skipped"], state["seconds"]
        self.field_steps, self.field_seconds = state["field_steps"], state["field_seconds"]
        self.objective.load_state_dict(state["objective"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["generator"].cpu())
        self.history = json.loads(state["history"])
        if self.errors:
            self.errors.mean = state["errors"].cpu()
        rig = dataclasses.replace(self.body.rig, **state["rig"])
        # from the fit, as in an uninterrupted training, so that it is the same bit by bit
        self.scene.bodies.set_poses(rig, state["theta"], state["root"])
        self._set_poses(self.scene.bodies)
        if self.step > self.field_steps:
            self._freeze_field()
        logger.info("resumed at step %d", self.step)

    def _lacks_snapshots(self, seconds: float) -> bool:
        """Return whether a snapshot that was due in the first `seconds` is missing, for example because another machine
        made the checkpoint; warn if so."""
        due_s = [s for s in self.settings.snapshots_s if s <= seconds]
        missing = [str(folder) for folder in map(self._snapshot, due_s) if not (folder / "settings.json").exists()]
        if missing:
            logger.warning("%s: not there, though the checkpoint is later; the training starts again", missing[0])
        return bool(missing)

    def _snapshot(self, seconds: float) -> Path:
        return self.out / "snapshots" / f"{seconds:g}"

    def _save(self, folder: Path) -> None:
        """Write what `load_avatar` reads: field, settings and fine-tuned body."""
        folder.mkdir(parents=True, exist_ok=True)
        bodies = self.scene.bodies
        BodyFit(bodies.rig, self.body.frames, bodies.theta, bodies.root).to("cpu").save(folder)
        write_field(self.field, folder / "model.safetensors")
        settings: dict[str, Any] = {"static": self.static, "training": self.settings.model_dump()}
        settings["decisions"] = {name: dataclasses.asdict(decision) for name, decision in self.decisions.items()}
        settings |= {"gains": self.gains, "seconds": self.seconds}
        (folder / "settings.json").write_text(json.dumps(settings, indent=1))

    def _finish(self) -> TrainingReport:
        out = self.out
        self._save(out)
        turn, move_m, _ = self.objective.correction.totals()
        report: TrainingReport = {
            "device": _device_name(self.processes.device),
            "processes": self.processes.world_size,
            "setup_seconds": self.setup_seconds,
            "seconds": self.seconds,
            "field_seconds": self.field_seconds,
            "steps": self.step,
            "peak_memory_gib": _peak_memory_gib(self.processes.device),
            "parameters": sum(p.numel() for p in self.field.parameters()),
            "model_mib": (out / "model.safetensors").stat().st_size / 2**20,
            "mean_turn_deg": float(np.rad2deg(turn.norm(dim=-1).mean().item())),
            "mean_move_mm": float(1e3 * move_m.norm(dim=-1).mean().item()),
            "decisions": [
                {"setting": name, "value": d.value, "reason": d.reason} for name, d in self.decisions.items()
            ],
        }
        write_result(out / "report.json", TrainingReport, report)
        return report


def train(
    capture: Capture,
    masks: Masks,
    body: BodyFit,
    settings: TrainingSettings,
    out: Path,
    processes: Distributed | None = None,
) -> TrainingReport | None:
    """Train the subject into `out`, continuing from its checkpoint if there is one; return the report, None in a
    process that writes none.

    The last checkpoint is kept, so that a training stopped while writing its files need only write them again; the
    caller deletes it. Raises TrainingError if the surface collapses or the losses stay non-finite.
    """
    return Trainer(capture, masks, body, settings, out, processes or Distributed.join()).run()


def _progress_message(row: dict[str, Any]) -> str:
    """Return a row of the history in words: losses that are not zero, and the PSNR on unseen frames if there are
    any."""
    message = [f"{name} {value:.2g}" for name, value in row["losses"].items() if value]
    if "held_out" in row:
        message.append(f"{row['held_out']['psnr']:.1f} dB on unseen frames")
    return ", ".join(message)


def _device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"CPU, {torch.get_num_threads()} threads"


def _peak_memory_gib(device: torch.device) -> float:
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**30
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20

"""Collapse: a surface that is empty or fills the box ends training with an error, at the real thresholds."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from hnerf.fields import fast
from hnerf.fields.base import Field
from hnerf.fields.fast import FastField
from hnerf.fields.paper import PaperField
from hnerf.fields.samples import RaySamples
from hnerf.training import fixed_rays
from hnerf.training.fixed_rays import FixedRays
from hnerf.training.pixels import PixelRays
from hnerf.training.step import TrainingError
from hnerf.training.trainer import Trainer
from tests.training.scene import ALONE, record, tiny

Relabelled = Callable[[PixelRays, RaySamples], tuple[Tensor, Tensor]]  # which rays are at edges, which show the person

FAR = 10.0  # units of the residual's last layer: metres away in either field


@pytest.fixture(autouse=True)
def few_rays_and_coarse_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use few rays, which suffice to tell empty from full, and coarse steps to tighten the shell."""
    monkeypatch.setattr(fixed_rays, "RAYS", 128)
    monkeypatch.setattr(fast, "TIGHTEN_STEP_M", 0.02)


def trainer_of(folder: Path, kind: str) -> Trainer:
    """Return a trainer for two steps."""
    settings = tiny(kind, steps=2, novel_pose_steps=0)
    return Trainer(*record(folder / "capture"), settings, folder, ALONE)


def move_surface(field: Field, outwards: float) -> None:
    """Move the surface outwards: subtract an offset from the distance residual that the field's network predicts."""
    assert isinstance(field, PaperField | FastField)
    last = field.residual.residual if isinstance(field, PaperField) else field.field.geometry[-1]
    assert isinstance(last, nn.Linear)
    last.bias.data.sub_(outwards)


@pytest.mark.parametrize("kind", ["fast", "paper"])
def test_the_body_itself_is_accepted_as_a_surface(tmp_path: Path, kind: str):
    trainer_of(tmp_path, kind).run()


def test_a_surface_between_training_samples_is_not_a_collapse(tmp_path: Path):
    """With two samples per ray across 5 m, hardly any falls into the column."""
    trainer = trainer_of(tmp_path, "paper")
    trainer.field.samples = 2
    rays, samples = trainer.fixed_rays.sample(trainer.scene, trainer.train_rows)
    assert trainer.field.coverage(samples)[rays.person].mean() < fixed_rays.MIN_PERSON_COVERAGE
    trainer.fixed_rays.require_surface(trainer.scene, trainer.train_rows)


@pytest.mark.parametrize(
    ("kind", "outwards", "message"),
    [
        ("fast", -FAR, r"surface is empty \(covers 0% of the person\): check masks and body fit"),
        ("paper", FAR, r"surface fills the box \(covers 100% of the surroundings\): check the masks"),
    ],
)
def test_a_collapsed_surface_is_an_error(tmp_path: Path, kind: str, outwards: float, message: str):
    trainer = trainer_of(tmp_path, kind)
    move_surface(trainer.field, outwards)
    with pytest.raises(TrainingError, match=message):
        trainer.run()


def require_surface_if(relabelled: Relabelled, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check the surface of an untrained `fast` field, which is the body's, on rays with other labels."""
    trainer = trainer_of(folder, "fast")
    sample = trainer.fixed_rays.sample

    def sample_relabelled(_: FixedRays, *given: Any) -> tuple[PixelRays, RaySamples]:
        rays, samples = sample(*given)
        edge, person = relabelled(rays, samples)
        return dataclasses.replace(rays, edge=edge, person=person), samples

    monkeypatch.setattr(FixedRays, "sample", sample_relabelled)
    trainer.fixed_rays.require_surface(trainer.scene, trainer.train_rows)


def test_a_single_pixel_away_from_outlines_does_not_decide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The mask may be wrong there. Here one pixel is labelled as outside the person, and all others as outline."""

    def with_one_clear(rays: PixelRays, _: RaySamples) -> tuple[Tensor, Tensor]:
        (shown,) = torch.nonzero(rays.person)[:1, 0]
        edge, person = torch.ones_like(rays.edge), rays.person.clone()
        edge[shown], person[shown] = False, False
        return edge, person

    require_surface_if(with_one_clear, tmp_path, monkeypatch)


def test_holes_in_masks_are_not_taken_for_surroundings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Every second pixel of the person is labelled as background away from outlines, and the background as outline."""
    monkeypatch.setattr(fixed_rays, "RAYS", 512)

    def with_holes(rays: PixelRays, _: RaySamples) -> tuple[Tensor, Tensor]:
        holes, edge, person = torch.nonzero(rays.person)[::2, 0], ~rays.person, rays.person.clone()
        edge[holes], person[holes] = False, False
        return edge, person

    require_surface_if(with_holes, tmp_path, monkeypatch)


def test_a_surface_that_covers_outlines_alone_does_not_fill_the_box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Every second pixel of the person is labelled as outline, and only five pixels beside it as background."""
    monkeypatch.setattr(fixed_rays, "RAYS", 512)

    def with_wide_outlines(rays: PixelRays, samples: RaySamples) -> tuple[Tensor, Tensor]:
        outline = torch.nonzero(rays.person)[::2, 0]
        beside = torch.nonzero(~rays.person & (samples.in_box > 0).any(1))[:, 0]
        edge, person = torch.zeros_like(rays.edge), rays.person.clone()
        edge[outline], person[outline], person[beside[5:]] = True, False, True
        return edge, person

    require_surface_if(with_wide_outlines, tmp_path, monkeypatch)


def test_a_nan_distance_counts_as_an_empty_surface(tmp_path: Path):
    trainer = trainer_of(tmp_path, "fast")
    move_surface(trainer.field, float("nan"))
    with pytest.raises(TrainingError, match="surface is empty"):
        trainer.fixed_rays.require_surface(trainer.scene, trainer.train_rows)

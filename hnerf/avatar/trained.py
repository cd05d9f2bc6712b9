"""Build a field for training, and load a trained one as an Avatar."""

import dataclasses
import json
from pathlib import Path

import torch
from pydantic import ValidationError
from safetensors.torch import load_file

from hnerf import config
from hnerf.avatar.avatar import Avatar, Gains
from hnerf.avatar.model_file import load_field, version_error
from hnerf.baselines.idr import IdrField
from hnerf.baselines.nerf import NerfField
from hnerf.baselines.nerfies import NerfiesField
from hnerf.baselines.neural_body import NeuralBodyField
from hnerf.body.fit_result import BodyFit
from hnerf.errors import InputError
from hnerf.fields.base import Field
from hnerf.fields.fast import FastField
from hnerf.fields.paper import PaperField

FIELDS: dict[type[config.FieldSettings], type[Field]] = {
    config.FastFieldSettings: FastField,
    config.PaperFieldSettings: PaperField,
    config.NerfSettings: NerfField,
    config.IdrSettings: IdrField,
    config.NeuralBodySettings: NeuralBodyField,
    config.NerfiesSettings: NerfiesField,
}


def build_field(settings: config.FieldSettings, body: BodyFit, static: bool) -> Field:
    """Return an untrained field around the fitted body; static: the capture has one training frame.

    Raises InputError if the field models one moment and there are more frames.
    """
    if not (static or settings.models_motion):
        raise InputError(f"{settings.no_new_poses}; choose a single training frame, or another method")
    return FIELDS[type(settings)].build(body, settings, static)


def load_avatar(folder: Path, device: torch.device | str | None = None) -> Avatar:
    """Load the subject that training left in `folder`, onto the GPU if there is one and no other device is named.
    Raises InputError if another version wrote it."""
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")
    settings, static, gains = stored_settings(folder)
    body = BodyFit.load(folder).to(device)
    path = folder / "model.safetensors"
    tensors = load_file(path, device=str(device))
    if "canonical_m" not in tensors:
        raise version_error(path)
    before_tuning = dataclasses.replace(body, rig=dataclasses.replace(body.rig, vertices_m=tensors["canonical_m"]))
    field = build_field(settings.field, before_tuning, static).to(device)
    load_field(field, tensors, path)
    return Avatar(field.eval(), body, body, gains)


def stored_settings(folder: Path) -> tuple[config.TrainingSettings, bool, Gains]:
    """Return the settings of the training that wrote `folder`, whether it had one training frame, and the gains of its
    cameras. Raises InputError if another version wrote them."""
    path = folder / "settings.json"
    stored = json.loads(path.read_text())
    try:
        gains = {name: tuple(gain) for name, gain in stored.get("gains", {}).items()}
        return config.TrainingSettings.model_validate(stored["training"]), stored["static"], gains
    except (KeyError, ValidationError):
        raise version_error(path) from None

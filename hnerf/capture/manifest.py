"""`capture.toml`: what a layout does not say itself, and which cameras and frames are for what."""

import difflib
import logging
import math
import re
import unicodedata
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidatorFunctionWrapHandler,
    field_validator,
)

from hnerf.capture.keypoint_sets import KeypointSetName
from hnerf.capture.safe_io import path_in_capture, read_toml
from hnerf.config import validated
from hnerf.errors import InputError

log = logging.getLogger("hnerf.capture")

TYPING_ERROR = 0.8  # likeness (difflib's) of an unknown key to a known one, from which on it is taken for a mistake
MAX_NAME_BYTES = 200  # file systems take 255, for names that are made of it too

FrameNumber = Annotated[int, Field(ge=0, le=999_999_999)]


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class CameraSplit(_Table):
    """Test cameras are for scoring only."""

    train: list[str] = Field(min_length=1)
    test: list[str] = []


class FrameSplit(_Table):
    """Novel-pose frames are fitted but not trained on."""

    train: list[FrameNumber] = Field(min_length=1)
    novel_pose: list[FrameNumber] = []


class CaptureManifest(_Table):
    """`capture.toml`. Descriptive keys (subject, licence, ...) are anyone's own; those below have a meaning."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)

    name: str | None = None
    fps: float | None = Field(default=None, gt=0, le=10_000)
    up: Literal["y", "z"] = "z"
    units: Literal["m", "mm"] | Annotated[float, Field(gt=0, le=1e6)] = "m"
    keypoints: KeypointSetName | None = None
    cameras: CameraSplit | None = None
    frames: FrameSplit | None = None

    @field_validator("units", mode="wrap")
    @classmethod
    def _one_message_for_all(cls, units: Any, checked: ValidatorFunctionWrapHandler) -> Any:
        try:
            return checked(units)
        except ValidationError:
            raise ValueError('give "m", "mm", or a number: how many metres a unit has') from None

    @property
    def metres_per_unit(self) -> float:
        """The calibration's unit of length."""
        return {"m": 1.0, "mm": 1e-3}[self.units] if isinstance(self.units, str) else self.units


def read_manifest(folder: Path) -> CaptureManifest:
    """The folder's `capture.toml`, or the defaults without one; InputError on a bad key or value."""
    path = path_in_capture(folder, "capture.toml")
    if not path.exists():
        return CaptureManifest()
    tree, known = read_toml(path), [*CaptureManifest.model_fields, "board"]
    for key in sorted(set(tree).difference(known)):
        if meant := difflib.get_close_matches(key.lower(), known, 1, TYPING_ERROR):
            raise InputError(f"{path}: {key} has no meaning; did you mean {meant[0]}? Else call it something else")
    return validated(CaptureManifest, tree, path)


def capture_name(folder: Path, notes: CaptureManifest) -> str:
    """What the subject is called; it becomes a folder name, so InputError if it cannot be one."""
    name = unicodedata.normalize("NFC", folder.resolve().name if notes.name is None else notes.name)  # macOS: NFD
    if not re.fullmatch(r"\w[\w .()-]{0,127}", name):
        raise InputError(f"{folder / 'capture.toml'}: name {name!r}: use letters, digits, '_', '-', '.' and spaces")
    if len(name.encode()) > MAX_NAME_BYTES:
        raise InputError(f"{folder / 'capture.toml'}: name of {len(name.encode())} bytes; keep to {MAX_NAME_BYTES}")
    return name


def chosen_cameras(folder: Path, notes: CaptureManifest, calibrated: list[str], published: list[str]) -> CameraSplit:
    """The cameras that `capture.toml` names, else the published ones for training and the rest for testing, else all
    for training; InputError on one unknown or named twice."""
    if notes.cameras is None:
        train = published or calibrated
        return CameraSplit(train=train, test=[name for name in calibrated if name not in train])
    _check(folder, "camera", notes.cameras.train + notes.cameras.test, calibrated, "the calibration")
    return notes.cameras


def chosen_frames(
    folder: Path, notes: CaptureManifest, recorded: tuple[int, ...], novel_pose_share: float, max_frames: int
) -> FrameSplit:
    """The frames that `capture.toml` names, else the first of the recorded ones for training and a last share for novel
    poses, evenly strided so that at most `max_frames` are for training.

    Neighbouring frames of a long recording are nearly the same picture, while fitting and training pay for each.
    InputError on a frame that is not recorded or is named twice.
    """
    if notes.frames is None:
        novel = recorded[len(recorded) - int(novel_pose_share * len(recorded)) :]
        train = recorded[: len(recorded) - len(novel)]
        stride = math.ceil(len(train) / max_frames)
        split = FrameSplit(train=list(train[::stride]), novel_pose=list(novel[::stride]))
        if stride > 1:
            taken = len(split.train) + len(split.novel_pose)
            log.info("%d of %d frames taken, one in %d; name others in capture.toml", taken, len(recorded), stride)
        return split
    _check(folder, "frame", notes.frames.train + notes.frames.novel_pose, recorded, "the recording")
    return notes.frames


def _check(folder: Path, what: str, named: list, known: Collection, where: str) -> None:
    path, known_set = folder / "capture.toml", set(known)
    for item in named:
        if item not in known_set:
            raise InputError(f"{path}: {what} {item} is not in {where}; correct [{what}s]")
    if len(set(named)) < len(named):
        raise InputError(f"{path}: a {what} is named twice; correct [{what}s]")

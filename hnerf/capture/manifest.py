"""`capture.toml`: settings that a layout does not state itself, and the splits of cameras and frames."""

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
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
)

from hnerf.capture.capture import SubjectPoint
from hnerf.capture.footage import MAX_FPS, MIN_FPS
from hnerf.capture.keypoint_sets import KeypointSetName
from hnerf.capture.safe_io import path_in_capture, read_toml, shown
from hnerf.config import validated
from hnerf.errors import InputError

log = logging.getLogger("hnerf.capture")

MIN_KEY_SIMILARITY = 0.8  # of an unknown key to a known one (difflib), from which it counts as a typo
MAX_BYTES = 65_536
NAMED_BY, NUMBER = "nearest", r"\s*(-?\d{1,9}(?:\.\d*)?)\s*"
SUBJECT = re.compile(rf"nearest to \({NUMBER},{NUMBER}\)(?: in (.+?)(?: at frame (\d{{1,9}}))?)?")
RANGE = re.compile(r"[0-9]{1,9}:[0-9]{1,9}(:[1-9][0-9]{0,8})?")
MAX_RANGE = 1_000_000  # frames: nine hours at 30 a second, and a bound on memory
NO_FRAME = -1  # of a subject's point without a frame
MAX_NAME_BYTES = 200  # file systems allow 255, which must also hold longer names made from it

FrameNumber = Annotated[int, Field(ge=0, le=999_999_999)]


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class CameraSplit(_Table):
    """Cameras for training and for testing. Test cameras are for scoring only."""

    train: list[str] = Field(min_length=1)
    test: list[str] = []


class FrameSplit(_Table):
    """Frames for training and of novel poses. Novel-pose frames are fitted but not trained on."""

    train: list[FrameNumber] = Field(min_length=1)
    novel_pose: list[FrameNumber] = []

    @field_validator("train", "novel_pose", mode="before")
    @classmethod
    def _written_out(cls, frames: Any, info: ValidationInfo) -> Any:
        """Return the frames of a range, without those that are trained on if it is of novel poses."""
        if not isinstance(frames, str):
            return frames
        numbers = range(*map(int, frames.split(":"))) if RANGE.fullmatch(frames) else range(0)
        if not 0 < len(numbers) <= MAX_RANGE:
            raise ValueError('give a list of frames, or "FIRST:END" or "FIRST:END:STEP", END excluded')
        trained = set(info.data.get("train", ()))
        left = [frame for frame in numbers if frame not in trained]
        if not left:
            raise ValueError("all frames of this range are under train; name others")
        return left


TABLES: dict[str, type[_Table]] = {"cameras": CameraSplit, "frames": FrameSplit}


class CaptureManifest(_Table):
    """The content of `capture.toml`. Descriptive keys (licence, ...) are free; those below have a meaning. `subject` is
    descriptive, too, unless it begins with "nearest"."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)

    name: str | None = None
    fps: float | None = Field(default=None, ge=MIN_FPS, le=MAX_FPS)
    up: Literal["y", "z"] = "z"
    units: Literal["m", "mm"] | Annotated[float, Field(ge=1e-6, le=1e6)] = "m"
    keypoints: KeypointSetName | None = None
    field_of_view_deg: float | None = Field(default=None, ge=10, le=150)
    stature_m: float | None = Field(default=None, ge=0.5, le=2.5)
    cameras: CameraSplit | None = None
    frames: FrameSplit | None = None
    subject: Any = None

    @field_validator("subject")
    @classmethod
    def _a_point_that_can_be_read(cls, subject: Any) -> Any:
        if isinstance(subject, str) and subject.lower().startswith(NAMED_BY) and not SUBJECT.fullmatch(subject):
            raise ValueError(
                'write "nearest to (x, y)", metres on the ground, or "nearest to (x, y) in CAMERA at frame N", pixels'
            )
        return subject

    @property
    def subject_point(self) -> SubjectPoint | None:
        """Return the point by which the subject is named, in recorded pixels or in metres; None if there is none. The
        frame is NO_FRAME if none is given."""
        named = SUBJECT.fullmatch(self.subject) if isinstance(self.subject, str) else None
        if not named:
            return None
        x, y, camera, frame = named.groups()
        return SubjectPoint((float(x), float(y)), camera or "", int(frame or NO_FRAME))

    @field_validator("units", mode="wrap")
    @classmethod
    def _one_message_for_all(cls, units: Any, checked: ValidatorFunctionWrapHandler) -> Any:
        try:
            return checked(units)
        except ValidationError:
            raise ValueError('give "m", "mm", or a number: how many metres a unit has') from None

    @property
    def metres_per_unit(self) -> float:
        """Return the calibration's unit of length in metres."""
        return {"m": 1.0, "mm": 1e-3}[self.units] if isinstance(self.units, str) else self.units


def read_manifest(folder: Path) -> CaptureManifest:
    """Read the folder's `capture.toml`, or return the defaults without one. Raises InputError on a bad key or value."""
    path = path_in_capture(folder, "capture.toml")
    if not path.exists():
        return CaptureManifest()
    tree, known = read_toml(path, MAX_BYTES), [*CaptureManifest.model_fields, "board"]
    for key in sorted(set(tree).difference(known)):
        if meant := difflib.get_close_matches(key.lower(), known, 1, MIN_KEY_SIMILARITY):
            raise InputError(f"{path}: {key[:80]} has no meaning; did you mean {meant[0]}? If not, rename it")
        tables = [f"[{name}]" for name, table in TABLES.items() if key in table.model_fields]
        if tables and isinstance(tree[key], list):
            raise InputError(f"{path}: {key} is in no table; put it under {' or '.join(tables)}, or rename it")
    return validated(CaptureManifest, tree, path)


def capture_name(folder: Path, manifest: CaptureManifest) -> str:
    """Return the name of the subject: from `capture.toml`, else from the folder or the video, with characters replaced
    that the name of a results folder cannot have. Raises InputError if the name is invalid or too long."""
    place = folder.resolve()
    source, given = folder / "capture.toml", manifest.name
    if given is None:
        source, given = folder, place.stem if place.is_file() else place.name
    name = unicodedata.normalize("NFC", given)  # macOS: NFD
    if manifest.name is None:
        name = re.sub(r"[^\w .()-]|^\W", "_", name)
    if not re.fullmatch(r"\w[\w .()-]{0,127}", name):
        raise InputError(f"{source}: name {shown(name)}: rename it; use letters, digits, '_', '-', '.' and spaces")
    if len(name.encode()) > MAX_NAME_BYTES:
        raise InputError(f"{source}: name of {len(name.encode())} bytes; keep to {MAX_NAME_BYTES}")
    return name


def chosen_cameras(
    folder: Path, manifest: CaptureManifest, known: list[str], published: list[str], where: str = "the calibration"
) -> CameraSplit:
    """Return the cameras that `capture.toml` names, else the published ones for training and the rest for testing, else
    all for training. where: what lists the known ones. Raises InputError on one that is unknown or named twice."""
    if manifest.cameras is None:
        train = published or known
        return CameraSplit(train=train, test=[name for name in known if name not in train])
    _check(folder, "camera", manifest.cameras.train + manifest.cameras.test, known, where)
    return manifest.cameras


def chosen_frames(
    folder: Path, manifest: CaptureManifest, recorded: tuple[int, ...], novel_pose_share: float, max_frames: int
) -> FrameSplit:
    """Return the frames that `capture.toml` names, else the recorded ones: the last share for novel poses, the others
    for training, evenly strided so that at most `max_frames` are for training.

    Neighbouring frames of a long recording are nearly identical, but each costs time to fit and train on. Raises
    InputError on a frame that is not recorded or is named twice.
    """
    if manifest.frames is None:
        novel = recorded[len(recorded) - int(novel_pose_share * len(recorded)) :]
        train = recorded[: len(recorded) - len(novel)]
        stride = math.ceil(len(train) / max_frames)
        split = FrameSplit(train=list(train[::stride]), novel_pose=list(novel[::stride]))
        if stride > 1:
            taken = len(split.train) + len(split.novel_pose)
            log.info("%d of %d frames taken, one in %d; name others in capture.toml", taken, len(recorded), stride)
        return split
    _check(folder, "frame", manifest.frames.train + manifest.frames.novel_pose, recorded, "the recording")
    return manifest.frames


def _check(folder: Path, what: str, named: list, known: Collection, where: str) -> None:
    """Raise InputError if a named camera or frame is unknown, or is named twice."""
    path, known_set = folder / "capture.toml", set(known)
    for item in named:
        if item not in known_set:
            raise InputError(f"{path}: {what} {str(item)[:80]} is not in {where}; correct [{what}s]")
    if len(set(named)) < len(named):
        raise InputError(f"{path}: a {what} is named twice; correct [{what}s]")

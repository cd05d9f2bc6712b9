"""Files of a finished run whose digests were not checked, such as those in a copy of a subject's folder."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
from safetensors import SafetensorError

from hnerf.avatar.avatar import Avatar
from hnerf.avatar.trained import load_avatar, stored_settings
from hnerf.calibration.calibrated import load_cameras
from hnerf.capture.capture import Capture
from hnerf.capture.safe_io import ARRAY_FILE_ERRORS
from hnerf.errors import InputError, one_line

# OpenCV raises SystemError on truncated YAML. Faults of the disk itself (OSError) pass unchanged.
DAMAGED = (
    *(kind for kind in ARRAY_FILE_ERRORS if kind is not OSError), IndexError, SafetensorError, SystemError, cv2.error,
)  # fmt: skip


@contextmanager
def readable(part: Path) -> Iterator[None]:
    """Raise InputError, naming this file or folder of a run, if reading it inside the context fails: it is truncated,
    or another version wrote it."""
    try:
        yield
    except DAMAGED as error:
        why = f"damaged, or written by another version ({one_line(error)})"
        raise InputError(f"{part}: {why}; copy the subject again, or repeat its `hnerf run`") from None


def require_files(subject: Path, files: Iterable[str]) -> None:
    """Raise InputError if a subject (<store>/subjects/<name>) lacks one of these files."""
    for file in files:
        if not (subject / file).is_file():
            raise InputError(f"{subject / file}: missing; give <store>/subjects/<name> of a finished `hnerf run`")


def recording_of(subject: Path) -> Capture:
    """Load a subject's recording, with its calibrated cameras."""
    with readable(subject / "capture" / "capture.json"):
        capture = Capture.load(subject / "capture")
    with readable(subject / "calibration"):
        return load_cameras(subject / "calibration", capture)


def avatar_of(subject: Path) -> Avatar:
    """Load a subject's trained avatar, onto the GPU if there is one."""
    with readable(subject / "training"):
        return load_avatar(subject / "training")


def reason_without_novel_poses(training: Path) -> str | None:
    """Return why a trained model, by its folder, cannot show poses that it was not trained on; None if it can."""
    settings, static, _ = stored_settings(training)
    if settings.field.kind == "paper" and static:
        return "H-NeRF's static network models one moment"
    return settings.field.no_new_poses or None


def require_poses(subject: Path, what: str) -> None:
    """Raise InputError if the model of a subject's folder cannot show poses that it was not trained on; what: the
    request, which needs them."""
    with readable(subject / "training"):
        reason = reason_without_novel_poses(subject / "training")
    if reason:
        advice = "train with preset fast, or with paper on several frames"
        raise InputError(f"{subject}: {reason}; {what} needs new poses: {advice}")

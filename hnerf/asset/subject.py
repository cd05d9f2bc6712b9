"""The asset of a finished subject, exported again with other settings or further motions."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hnerf.asset.blender import require_blender
from hnerf.asset.export import export_asset
from hnerf.asset.staging import CAPTURED
from hnerf.avatar.finished import avatar_of, readable, recording_of, require_files, require_poses
from hnerf.body.fit_result import BodyFit
from hnerf.capture.masks import Masks
from hnerf.config import AssetSettings
from hnerf.errors import InputError
from hnerf.files import atomic_folder
from hnerf.render.motion import T_POSE, Motion, read_motion, t_pose_motion

NEEDED = ("capture/capture.json", "calibration/intri.yml", "segmentation/report.json", "training/model.safetensors")
LONGEST_NAME = 200  # of a motion; its payload's name is longer, and file systems take 255 bytes


def export_subject(
    subject: Path,
    settings: AssetSettings,
    motions: Iterable[Path],
    out: Path,
    digest: str,
    blender: str | None = None,
) -> dict[str, Any]:
    """Export a subject (<store>/subjects/<name>) into the new folder `out`; return the report of `export_asset`.

    motions: files or subjects to add (`read_motion`), named after their files, or T_POSE; digest: of the recording;
    blender: program that adds FBX and Alembic. Raises InputError if a file is missing, a motion cannot be read, its
    name is already in use, or that program cannot be used.
    """
    with atomic_folder(out) as partial:
        if blender:
            require_blender(blender)
        require_files(subject, NEEDED)
        require_poses(subject, "an asset")
        further = _named(motions, subject)
        capture, avatar = recording_of(subject), avatar_of(subject)
        with readable(subject / "segmentation"):
            masks = Masks.load(subject / "segmentation")
        return export_asset(capture, masks, avatar, settings, partial, digest, further, blender)


def _named(motions: Iterable[Path], subject: Path) -> dict[str, Motion]:
    """Read motions; each is named after its file or folder, with underscores for characters that a name cannot have."""
    found: dict[str, Motion] = {}
    for path in motions:
        called = path.resolve().name if path.is_dir() else path.stem  # a subject's name may have dots
        name = re.sub(r"\W+", "_", called, flags=re.ASCII).strip("_")
        same = name.lower()  # payloads are named after motions, and Windows and macOS ignore case
        if not 0 < len(name) <= LONGEST_NAME or same in map(str.lower, found) or same.startswith(CAPTURED):
            why = f"empty, longer than {LONGEST_NAME}, reserved or already in use"
            raise InputError(f"{path}: motion name {name!r} is {why}; rename the file")
        found[name] = _t_pose(subject) if path == T_POSE else read_motion(path)
    return found


def _t_pose(subject: Path) -> Motion:
    """Return the T pose of a subject's own rig."""
    with readable(subject / "training"):
        return t_pose_motion(BodyFit.load(subject / "training").rig)

"""How each split shows a trained avatar. New poses have three columns, from what an avatar does in any motion to what
was tuned on the pictures of these very frames."""

import json
from pathlib import Path

from hnerf.avatar.avatar import Avatar
from hnerf.body.fit_result import BodyFit
from hnerf.config import TrainingSettings
from hnerf.evaluation.views import ANIMATED, NEW_POSES, POSED, TRACKED


def shown_as(split: str, avatar: Avatar, fitted: BodyFit) -> Avatar:
    """The avatar whose `body` has the poses of a split.

    ANIMATED: with the poses of `fitted`, the body before training; POSED: with those that training tuned; both without
    what was learned of single frames. TRACKED, as all splits of training frames: as training left it.
    """
    if split == ANIMATED:
        device = avatar.body.theta.device
        poses = BodyFit(avatar.body.rig, fitted.frames, fitted.theta.to(device), fitted.root.to(device))
        return avatar.without_frames().with_body(poses)
    return avatar.without_frames() if split == POSED else avatar


def why_not_shown(split: str, training: Path) -> str | None:
    """Why what training left in a folder has nothing of its own to show under a split; None if it has."""
    reason = why_no_novel_poses(training) if split in NEW_POSES else None
    if reason or split not in (POSED, TRACKED):
        return reason
    settings = json.loads((training / "settings.json").read_text())["training"]
    steps, nodes = settings["novel_pose_steps"], settings["field"].get("nodes", 0)
    if split == POSED and not (steps and settings["pose_learning_rate"]):
        return "no pose of these frames was tuned"
    if split == TRACKED and not (steps and nodes):
        return "these frames have no deformation of their own"
    return None


def why_no_novel_poses(training: Path) -> str | None:
    """Why what training left in a folder cannot show poses that it was not trained on; None if it can."""
    stored = json.loads((training / "settings.json").read_text())
    field = TrainingSettings.model_validate(stored["training"]).field
    if field.kind == "paper" and stored["static"]:
        return "H-NeRF's static network models one moment"
    return field.no_new_poses or None

"""Which avatar each split shows. Novel poses have three columns: animated, posed and tracked, which differ in what was
tuned on the images of these very frames."""

from pathlib import Path

from hnerf.avatar.avatar import Avatar
from hnerf.avatar.finished import reason_without_novel_poses
from hnerf.avatar.trained import stored_settings
from hnerf.body.fit_result import BodyFit
from hnerf.evaluation.views import ANIMATED, NOVEL_POSE_SPLITS, POSED, TRACKED


def avatar_for_split(split: str, avatar: Avatar, fitted: BodyFit) -> Avatar:
    """Return the avatar whose `body` has the poses of a split.

    ANIMATED: the poses of `fitted`, the body before training; POSED: the poses that training tuned; both without what
    was learned for single frames. TRACKED, and all splits of training frames: the avatar as training left it.
    """
    if split == ANIMATED:
        device = avatar.body.theta.device
        poses = BodyFit(avatar.body.rig, fitted.frames, fitted.theta.to(device), fitted.root.to(device))
        return avatar.without_frames().with_body(poses)
    return avatar.without_frames() if split == POSED else avatar


def reason_unavailable(split: str, training: Path) -> str | None:
    """Return why a trained model, by its folder, has nothing of its own to show for a split; None if it does."""
    reason = reason_without_novel_poses(training) if split in NOVEL_POSE_SPLITS else None
    if reason or split not in (POSED, TRACKED):
        return reason
    settings, _, _ = stored_settings(training)
    if split == POSED and not (settings.novel_pose_steps and settings.pose_learning_rate):
        return "no pose of these frames was tuned"
    if split == TRACKED and not (settings.novel_pose_steps and getattr(settings.field, "nodes", 0)):
        return "these frames have no deformation of their own"
    return None

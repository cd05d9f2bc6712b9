"""The inputs of evaluation."""

from dataclasses import dataclass, field
from pathlib import Path

from hnerf.avatar.avatar import Avatar
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks


@dataclass(frozen=True)
class EvaluationInputs:
    """Everything that was made before evaluation.

    capture_folder: as recorded, for its ground_truth/; capture: with the calibrated cameras; fitted: the body before
    training (avatar.body holds the fine-tuned one); the folders hold their stages' report.json; held_out_folders:
    output of `score_held_out`, one per camera; fit_seconds: of each part of the fit.
    """

    capture_folder: Path
    capture: Capture
    masks: Masks
    fitted: BodyFit
    avatar: Avatar
    calibration_folder: Path
    segmentation_folder: Path
    fit_folder: Path
    training_folder: Path
    held_out_folders: tuple[Path, ...] = ()
    fit_seconds: dict[str, float] = field(default_factory=dict)

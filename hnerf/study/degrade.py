"""Everything that a stability study does to a good capture, by name."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.config import Section, TrainingSettings
from hnerf.errors import CaptureError
from hnerf.evaluation.ground_truth import GroundTruth
from hnerf.segmentation.masks import Masks
from hnerf.study import degraded_fit, degraded_images, degraded_masks, degraded_rig, occluder, worn

Place = Literal["capture", "worn", "masks", "fit", "settings", "poses"]
Rng = np.random.Generator


class Degradation(Section):
    """A name in KINDS, how strong in its unit, and the seed of what is drawn at random."""

    kind: str
    strength: float
    seed: int

    @property
    def rng(self) -> Rng:
        """The same draws for the same seed, whatever the strength."""
        return np.random.default_rng(self.seed)


@dataclass(frozen=True)
class Kind:
    """place: after which stage it is applied, "worn" being the capture once its body is fitted, "poses" those that a
    finished avatar is shown in; label with the strength's unit."""

    place: Place
    label: str


CaptureChange = Callable[[Capture, float, Rng, Path], None]
MasksChange = Callable[[Masks, Capture, float, Rng], Masks]
FitChange = Callable[[BodyFit, float, Rng], BodyFit]

CAPTURE: dict[str, CaptureChange] = {
    "cameras_left": degraded_rig.leave_cameras,
    "frames_left": degraded_rig.leave_frames,
    "camera_turned": degraded_rig.turn_camera,
    "camera_out_of_step": degraded_rig.put_out_of_step,
    "image_noise": degraded_images.add_noise,
    "image_blur": degraded_images.blur,
    "exposure": degraded_images.expose_differently,
    "small_images": degraded_images.resize,
    "large_images": degraded_images.resize,
    "occluder": occluder.put_in_front,
}
MASKS: dict[str, MasksChange] = {
    "mask_eroded": degraded_masks.erode,
    "mask_dilated": degraded_masks.dilate,
    "mask_holes": degraded_masks.pierce,
    "mask_limb": degraded_masks.cut_limb,
}
FIT: dict[str, FitChange] = {"pose_noise": degraded_fit.disturb_poses, "wrong_shape": degraded_fit.change_shape}

KINDS = {
    "cameras_left": Kind("capture", "training cameras left"),
    "frames_left": Kind("capture", "training frames left"),
    "camera_turned": Kind("capture", "one camera turned, °"),
    "camera_out_of_step": Kind("capture", "one camera late, frames"),
    "image_noise": Kind("capture", "image noise, levels of 255"),
    "image_blur": Kind("capture", "blur, % of image width"),
    "exposure": Kind("capture", "exposure between cameras, ± stops"),
    "small_images": Kind("capture", "image size, share"),
    "large_images": Kind("capture", "image size, multiple"),
    "occluder": Kind("capture", "pillar in front, width in m"),
    "skirt": Kind("worn", "skirt, hem off the legs in m"),
    "long_hair": Kind("worn", "long hair, m"),
    "mask_eroded": Kind("masks", "masks eroded, % of image width"),
    "mask_dilated": Kind("masks", "masks dilated, % of image width"),
    "mask_holes": Kind("masks", "holes, % of each mask"),
    "mask_limb": Kind("masks", "limb missing, % of masks"),
    "pose_noise": Kind("fit", "pose noise, ° a joint"),
    "wrong_shape": Kind("fit", "wrong shape, mm on average"),
    "learning_rate_up": Kind("settings", "learning rate times"),
    "learning_rate_down": Kind("settings", "learning rate times"),
    "extreme_poses": Kind("poses", "new pose, ° a joint"),
}


def degrade_capture(capture: Capture, degradation: Degradation, out: Path) -> None:
    """Write the degraded capture, normalised like the one given, into `out`."""
    CAPTURE[degradation.kind](capture, degradation.strength, degradation.rng, out)


def dress(capture: Capture, body: BodyFit, truth: GroundTruth, degradation: Degradation, out: Path) -> None:
    """Write the capture and what is known of it with clothes or hair that no body model expresses, into `out`."""
    worn.put_on(degradation.kind, degradation.strength, degradation.rng, capture, body, truth, out)


def degrade_masks(masks: Masks, capture: Capture, degradation: Degradation) -> Masks:
    """The same views' masks, degraded."""
    return MASKS[degradation.kind](masks, capture, degradation.strength, degradation.rng)


def degrade_fit(body: BodyFit, degradation: Degradation) -> BodyFit:
    """The same frames' poses or the shape, degraded."""
    return FIT[degradation.kind](body, degradation.strength, degradation.rng)


def degrade_settings(settings: TrainingSettings, degradation: Degradation) -> TrainingSettings:
    """Every learning rate times the strength: of the poses and of the method's own networks and grids."""
    rates = getattr(settings, settings.machinery).model_dump()
    own = {name: value * degradation.strength for name, value in rates.items() if name.endswith("learning_rate")}
    changed = getattr(settings, settings.machinery).model_copy(update=own)
    pose_learning_rate = settings.pose_learning_rate * degradation.strength
    return settings.model_copy(update={settings.machinery: changed, "pose_learning_rate": pose_learning_rate})


def check_strengths(kind: str, strengths: tuple[float, ...]) -> None:
    """CaptureError unless the degradation is known and its strengths go one way, the mildest first."""
    if kind not in KINDS:
        raise CaptureError(f"degradation {kind}: no such thing; there are {', '.join(KINDS)}")
    growing = all(a < b for a, b in itertools.pairwise(strengths))
    falling = all(a > b for a, b in itertools.pairwise(strengths))
    if not strengths or not (growing or falling) or not all(math.isfinite(s) and s > 0 for s in strengths):
        raise CaptureError(f"degradation {kind}: give strengths above 0, the mildest first")
    if kind in ("mask_holes", "mask_limb") and max(strengths) > 100:
        raise CaptureError(f"degradation {kind}: a share in %, at most 100")

"""Everything that a stability study does to a good capture, by name."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.config import Section, TrainingSettings
from hnerf.errors import InputError
from hnerf.evaluation.ground_truth import GroundTruth
from hnerf.study.degradations import cameras as degraded_rig
from hnerf.study.degradations import clothing as worn
from hnerf.study.degradations import fit as degraded_fit
from hnerf.study.degradations import images as degraded_images
from hnerf.study.degradations import masks as degraded_masks
from hnerf.study.degradations import occluder

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
    finished avatar is shown in; label with the strength's unit.

    change: of the capture, written into a folder; of masks; or of a fitted body. Strengths go from `none`, at which
    nothing would change, to `most`, which may be one of them; whole: they count something.
    """

    place: Place
    label: str
    change: Callable[..., Any] | None = None
    none: float = 0.0
    most: float = math.inf
    whole: bool = False


KINDS = {
    "cameras_left": Kind("capture", "training cameras left", degraded_rig.leave_cameras, math.inf, 1, whole=True),
    "frames_left": Kind("capture", "training frames left", degraded_rig.leave_frames, math.inf, 1, whole=True),
    "camera_turned": Kind("capture", "one camera turned, °", degraded_rig.turn_camera),
    "camera_out_of_step": Kind("capture", "one camera late, frames", degraded_rig.put_out_of_step, whole=True),
    "image_noise": Kind("capture", "image noise, levels of 255", degraded_images.add_noise),
    "image_blur": Kind("capture", "blur, % of image width", degraded_images.blur),
    "exposure": Kind("capture", "exposure between cameras, ± stops", degraded_images.expose_differently),
    "small_images": Kind("capture", "image size, share", degraded_images.resize, 1, 0),
    "large_images": Kind("capture", "image size, multiple", degraded_images.resize, 1),
    "occluder": Kind("capture", "pillar in front, width in m", occluder.put_in_front),
    "skirt": Kind("worn", "skirt, hem off the legs in m"),
    "long_hair": Kind("worn", "long hair, m"),
    "mask_eroded": Kind("masks", "masks eroded, % of image width", degraded_masks.erode),
    "mask_dilated": Kind("masks", "masks dilated, % of image width", degraded_masks.dilate),
    "mask_holes": Kind("masks", "holes, % of each mask", degraded_masks.pierce, most=100),
    "mask_limb": Kind("masks", "limb missing, % of masks", degraded_masks.cut_limb, most=100),
    "pose_noise": Kind("fit", "pose noise, ° a joint", degraded_fit.disturb_poses),
    "wrong_shape": Kind("fit", "wrong shape, mm on average", degraded_fit.change_shape),
    "learning_rate_up": Kind("settings", "learning rate higher, times", none=1),
    "learning_rate_down": Kind("settings", "learning rate lower, times", none=1, most=0),
    "extreme_poses": Kind("poses", "new pose, ° a joint"),
}


def degrade_capture(capture: Capture, degradation: Degradation, out: Path) -> None:
    """Write the degraded capture, normalised like the one given, into `out`."""
    _change(degradation)(capture, degradation.strength, degradation.rng, out)


def dress(capture: Capture, body: BodyFit, truth: GroundTruth, degradation: Degradation, out: Path) -> None:
    """Write the capture and what is known of it with clothes or hair that no body model expresses, into `out`."""
    worn.add_clothing(degradation.kind, degradation.strength, degradation.rng, capture, body, truth, out)


def degrade_masks(masks: Masks, capture: Capture, degradation: Degradation) -> Masks:
    """The same views' masks, degraded."""
    changed: Masks = _change(degradation)(masks, capture, degradation.strength, degradation.rng)
    return changed


def degrade_fit(body: BodyFit, degradation: Degradation) -> BodyFit:
    """The same frames' poses or the shape, degraded."""
    changed: BodyFit = _change(degradation)(body, degradation.strength, degradation.rng)
    return changed


def degrade_settings(settings: TrainingSettings, degradation: Degradation) -> TrainingSettings:
    """Every learning rate times the strength: of the poses and of the method's own networks and grids."""
    rates = settings.field.model_dump()
    own = {name: value * degradation.strength for name, value in rates.items() if name.endswith("learning_rate")}
    pose_learning_rate = settings.pose_learning_rate * degradation.strength
    return settings.model_copy(
        update={"field": settings.field.model_copy(update=own), "pose_learning_rate": pose_learning_rate}
    )


def check_strengths(name: str, strengths: tuple[float, ...]) -> None:
    """InputError unless the degradation is known and its strengths go its way, the mildest first."""
    if name not in KINDS:
        raise InputError(f"degradation {name}: no such thing; there are {', '.join(KINDS)}")
    kind = KINDS[name]
    (low, high), way = sorted((kind.none, kind.most)), 1 if kind.none < kind.most else -1
    onwards = all(way * a < way * b for a, b in itertools.pairwise((kind.none, *strengths)))
    valid = all(0 < s < math.inf and low <= s <= high and not (kind.whole and s % 1) for s in strengths)
    if not (strengths and onwards and valid):
        what = f"{'whole ' * kind.whole}numbers between {low:g} and {high:g} that {'rise' if way > 0 else 'fall'}"
        raise InputError(f"degradation {name}: give {what}, the mildest first")


def _change(degradation: Degradation) -> Callable[..., Any]:
    change = KINDS[degradation.kind].change
    assert change is not None  # of capture, masks and fit
    return change

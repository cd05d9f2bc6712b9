"""The degradations that a stability study applies to a good capture, by name."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import inf
from typing import Any, Literal

import numpy as np

from hnerf.config import Section, TrainingSettings
from hnerf.errors import InputError
from hnerf.study.degradations import cameras, clothing, fit, images, masks, occluder

Target = Literal["capture", "clothing", "masks", "fit", "settings", "poses"]
Rng = np.random.Generator


class Degradation(Section):
    """A degradation: its name in KINDS, its strength in that kind's unit, and the seed of its random numbers."""

    kind: str
    strength: float
    seed: int

    @property
    def rng(self) -> Rng:
        """Return a generator that gives the same random numbers for the same seed, whatever the strength."""
        return np.random.default_rng(self.seed)

    def apply(self, *what: Any, **where: Any) -> Any:
        """Write a degraded capture into a folder `out`, normalised like the given one; for clothing, with its ground
        truth. Or return degraded masks of the same views, given masks and their capture, or a body fit with degraded
        poses or shape."""
        change = KINDS[self.kind].change
        assert change is not None  # degradations of capture, clothing, masks and fit have a function
        return change(*what, self.strength, self.rng, **where)


@dataclass(frozen=True)
class DegradationKind:
    """A kind of degradation. target: what it changes; "clothing" is the capture after its body was fitted, "poses" are
    those in which a finished avatar is shown. label: includes the strength's unit.

    change: the function that writes a changed capture into a folder, or changes masks or a fitted body. Strengths run
    from `neutral`, which would change nothing, to `limit`, inclusive; integer: whether they are counts.
    """

    target: Target
    label: str
    change: Callable[..., Any] | None = None
    neutral: float = 0.0
    limit: float = inf
    integer: bool = False


KINDS = {
    "cameras_left": DegradationKind("capture", "training cameras left", cameras.keep_cameras, inf, 1, integer=True),
    "frames_left": DegradationKind("capture", "training frames left", cameras.keep_frames, inf, 1, integer=True),
    "camera_turned": DegradationKind("capture", "one camera turned, °", cameras.rotate_camera),
    "camera_out_of_step": DegradationKind("capture", "one camera late, frames", cameras.delay_camera, integer=True),
    "image_noise": DegradationKind("capture", "image noise, levels of 255", images.add_noise),
    "image_blur": DegradationKind("capture", "blur, % of image width", images.blur),
    "exposure": DegradationKind("capture", "exposure of cameras, values times 2^±x", images.vary_exposure),
    "small_images": DegradationKind("capture", "image size, share", images.resize, 1, 0),
    "large_images": DegradationKind("capture", "image size, multiple", images.resize, 1),
    "occluder": DegradationKind("capture", "pillar in front, width in m", occluder.add_pillar),
    "skirt": DegradationKind(
        "clothing", "skirt, hem off the legs in m", partial(clothing.add_clothing, clothing.skirt)
    ),
    "long_hair": DegradationKind("clothing", "long hair, m", partial(clothing.add_clothing, clothing.long_hair)),
    "mask_eroded": DegradationKind("masks", "masks eroded, % of image width", masks.erode),
    "mask_dilated": DegradationKind("masks", "masks dilated, % of image width", masks.dilate),
    "mask_holes": DegradationKind("masks", "holes, % of each mask", masks.cut_holes, limit=100),
    "mask_limb": DegradationKind("masks", "limb missing, % of masks", masks.cut_limb, limit=100),
    "pose_noise": DegradationKind("fit", "pose noise, ° a joint", fit.add_pose_noise),
    "wrong_shape": DegradationKind("fit", "wrong shape, mm on average", fit.change_shape),
    "learning_rate_up": DegradationKind("settings", "learning rate higher, times", neutral=1),
    "learning_rate_down": DegradationKind("settings", "learning rate lower, times", neutral=1, limit=0),
    "extreme_poses": DegradationKind("poses", "new pose, ° a joint"),
}


def degrade_settings(settings: TrainingSettings, degradation: Degradation) -> TrainingSettings:
    """Multiply every learning rate by the strength: those of the poses and of the method's own networks and grids."""
    rates = settings.field.model_dump()
    own = {name: value * degradation.strength for name, value in rates.items() if name.endswith("learning_rate")}
    pose_learning_rate = settings.pose_learning_rate * degradation.strength
    return settings.model_copy(
        update={"field": settings.field.model_copy(update=own), "pose_learning_rate": pose_learning_rate}
    )


def check_strengths(name: str, strengths: tuple[float, ...]) -> None:
    """Raise InputError unless the degradation exists and its strengths are valid, the mildest first."""
    if name not in KINDS:
        raise InputError(f"degradation {name}: no such degradation; there are {', '.join(KINDS)}")
    kind = KINDS[name]
    (low, high), way = sorted((kind.neutral, kind.limit)), 1 if kind.neutral < kind.limit else -1
    onwards = all(way * a < way * b for a, b in itertools.pairwise((kind.neutral, *strengths)))
    valid = all(0 < s < inf and low <= s <= high and not (kind.integer and s % 1) for s in strengths)
    if not (strengths and onwards and valid):
        what = f"{'whole ' * kind.integer}numbers between {low:g} and {high:g} that {'rise' if way > 0 else 'fall'}"
        raise InputError(f"degradation {name}: give {what}, the mildest first")

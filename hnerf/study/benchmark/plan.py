"""What a benchmark compares: methods on parts of a capture, as a YAML file under `configs/benchmark/` says."""

from collections.abc import Sequence
from typing import Literal, Self

from pydantic import Field, PositiveInt, model_validator

from hnerf.capture.capture import Capture
from hnerf.capture.subset import select
from hnerf.config import CONFIGS, Section, Settings, load_settings, named_file, read_yaml, validated
from hnerf.errors import InputError
from hnerf.evenly_spaced import evenly_spaced
from hnerf.study.benchmark.convergence import FIRST_S

STUDIES = CONFIGS / "benchmark"
UNTIL_TIME_IS_UP = 1_000_000  # steps
FIRST_SNAPSHOT_S = 15.0  # where a training has no limit that could be halved


class Part(Section):
    """Part of a capture. cameras, frames: of training, how many of them or which; None is all."""

    cameras: PositiveInt | tuple[str, ...] | None = None
    frames: PositiveInt | tuple[int, ...] | None = None
    novel_poses: bool = True

    def parts(self, capture: Capture) -> tuple[tuple[str, ...] | None, tuple[int, ...] | None, tuple[int, ...] | None]:
        """Training cameras, training frames and novel-pose frames to keep, None for all.

        Fewer cameras are taken at equal steps of the capture's order, frames evenly spread over time. InputError if
        the capture has not as many, or not one of that name.
        """
        cameras, frames = self.cameras, self.frames
        if isinstance(cameras, int):
            there_are = _at_least(cameras, capture.train_cameras, "training cameras")
            cameras = tuple(there_are[k * len(there_are) // cameras] for k in range(cameras))
        elif cameras is not None:
            cameras = select(capture, "training camera", cameras, capture.train_cameras)
        if isinstance(frames, int):
            frames = tuple(evenly_spaced(_at_least(frames, capture.train_frames, "training frames"), frames))
        elif frames is not None:
            frames = select(capture, "training frame", frames, capture.train_frames)
        return cameras, frames, None if self.novel_poses else ()


class Variant(Part):
    """Part of a capture, and the methods of the study that are tried on it; none is all."""

    methods: tuple[str, ...] = ()


class Claim(Section):
    """What the paper says in its words, and which figures tell whether it is seen here (claims.py)."""

    says: str
    check: Literal[
        "more_is_better",
        "loses_least",
        "ahead",
        "falls_with_angle",
        "ahead_at_every_angle",
        "no_trend_with_pose",
        "others_have_no_surface",
    ]


class ScoringSettings(Section):
    """How much of what is held out is rendered and meshed. split: of curves and charts."""

    split: Literal["novel_view", "novel_pose"] = "novel_view"
    images: int | None = Field(default=None, ge=1)  # a split, of the finished model; None: all
    meshes: int = Field(default=2, ge=1)  # a split
    snapshot_images: int = Field(default=4, ge=1)
    snapshot_meshes: int = Field(default=1, ge=0)
    frame_sizes_px: tuple[PositiveInt, ...] = Field(default=(256, 512), min_length=1)  # longest sides, of timed images


class Study(Section):
    """A benchmark. methods: presets, that of H-NeRF first; seconds: of every training, None to each preset's own end;
    snapshots: how many are scored before it; until_flat: instead of them longer and longer trainings up to `seconds`
    (hnerf/study/benchmark/convergence.py)."""

    title: str
    notes: tuple[str, ...] = ()  # what a reader has to know, such as what is left out
    claims: tuple[Claim, ...] = ()
    seconds: float | None = Field(default=None, gt=0)
    snapshots: int = Field(default=4, ge=0, le=12)
    until_flat: bool = False
    sweep: Literal["cameras", "frames"] | None = None  # what the variants differ in, for a chart of its own
    methods: tuple[str, ...] = Field(min_length=1)
    variants: dict[str, Variant] = Field(min_length=1)
    scoring: ScoringSettings = ScoringSettings()

    @model_validator(mode="after")
    def _claims_of_a_sweep_have_one(self) -> Self:
        for claim in self.claims:
            if claim.check in ("more_is_better", "loses_least") and not self.sweep:
                raise ValueError(f"claims: {claim.check} asks for a sweep")
        return self

    @model_validator(mode="after")
    def _flat_within_a_time(self) -> Self:
        if self.until_flat and (self.seconds is None or self.seconds < FIRST_S or self.snapshots):
            raise ValueError(f"until_flat: asks for `snapshots: 0` and a longest training, `seconds` of {FIRST_S:g} up")
        return self

    def settings(self, method: str, seconds: float | None = None) -> Settings:
        """All stages' settings; training stops after `seconds`, of the study where they are None, and is saved on the
        way. Steps that are written down end H-NeRF alone: they are how long it needs, but what a compared method can do
        in its time is the question."""
        settings, seconds = load_settings(method), seconds or self.seconds
        training = {"seconds": seconds, "snapshots_s": snapshot_times_s(seconds, self.snapshots)}
        if seconds and not settings.training.field.tunes_poses:
            training["steps"] = UNTIL_TIME_IS_UP
        return settings.model_copy(update={"training": settings.training.model_copy(update=training)})

    def narrowed(self, names: Sequence[str], seconds: float | None) -> "Study":
        """The study of these methods alone and this time limit; one that it does not have is tried on every variant.
        Where there are no names it keeps its methods, and where there is no limit, its own."""
        methods = tuple(names) or self.methods
        variants = {}
        for title, variant in self.variants.items():
            there = variant.methods or self.methods
            if kept := tuple(name for name in methods if name in there or name not in self.methods):
                variants[title] = variant.model_copy(update={"methods": kept})
        changes = {"methods": methods, "variants": variants, "seconds": seconds or self.seconds}
        return self.model_copy(update=changes)


def load_study(name: str) -> Study:
    """A study by its name or its file's path; InputError with one line if there is none or a key is not allowed."""
    path = named_file(name, STUDIES, "study", "studies")
    study = validated(Study, read_yaml(path), path)
    for title, variant in study.variants.items():
        for method in variant.methods:
            if method not in study.methods:
                raise InputError(f"{path}: variants.{title}: no method {method}; there are {', '.join(study.methods)}")
    return study


def snapshot_times_s(seconds: float | None, count: int) -> tuple[float, ...]:
    """The time limit halved `count` times over, in ascending order; without a limit, doublings of 15 s."""
    if seconds is None:
        return tuple(FIRST_SNAPSHOT_S * 2**k for k in range(count))
    return tuple(seconds / 2**k for k in range(count, 0, -1))


def _at_least(count: int, items: Sequence, what: str) -> Sequence:
    if len(items) < count:
        raise InputError(f"the capture has {len(items)} {what}, not {count}")
    return items

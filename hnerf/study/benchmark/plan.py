"""Plan of a benchmark: methods on parts of a capture, read from a YAML file under `configs/benchmark/`."""

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
UNLIMITED_STEPS = 1_000_000  # never reached: the time limit ends a training first
FIRST_SNAPSHOT_S = 15.0  # for trainings without a time limit that could be halved


class CapturePart(Section):
    """Part of a capture. cameras, frames: those of training, as a number or a list; None keeps all."""

    cameras: PositiveInt | tuple[str, ...] | None = None
    frames: PositiveInt | tuple[int, ...] | None = None
    novel_poses: bool = True

    def select(self, capture: Capture) -> tuple[tuple[str, ...] | None, tuple[int, ...] | None, tuple[int, ...] | None]:
        """Return the training cameras, training frames and novel-pose frames to keep, None for all.

        A number of cameras is taken at equal steps in the capture's order, a number of frames evenly spaced over time.
        Raises InputError if the capture has fewer, or none of that name.
        """
        cameras, frames = self.cameras, self.frames
        if isinstance(cameras, int):
            available = _at_least(cameras, capture.train_cameras, "training cameras")
            cameras = tuple(available[k * len(available) // cameras] for k in range(cameras))
        elif cameras is not None:
            cameras = select(capture, "training camera", cameras, capture.train_cameras)
        if isinstance(frames, int):
            frames = tuple(evenly_spaced(_at_least(frames, capture.train_frames, "training frames"), frames))
        elif frames is not None:
            frames = select(capture, "training frame", frames, capture.train_frames)
        return cameras, frames, None if self.novel_poses else ()


class Variant(CapturePart):
    """Part of a capture, and the methods of the study to run on it; all if none are named."""

    methods: tuple[str, ...] = ()


class Claim(Section):
    """A claim of the paper, quoted, and the check that tests it on the result (claims.py)."""

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
    """How many held-out images are rendered and how many surfaces are meshed. split: of curves and charts."""

    split: Literal["novel_view", "novel_pose"] = "novel_view"
    images: int | None = Field(default=None, ge=1)  # per split, of the finished model; None: all
    meshes: int = Field(default=2, ge=1)  # per split
    snapshot_images: int = Field(default=4, ge=1)
    snapshot_meshes: int = Field(default=1, ge=0)
    frame_sizes_px: tuple[PositiveInt, ...] = Field(default=(256, 512), min_length=1)  # longest sides of timed images


class BenchmarkStudy(Section):
    """A benchmark. methods: presets; claims are about the first one of H-NeRF; seconds: time limit of every training,
    None for each preset's own end; snapshots: how many are scored before the end; until_flat: instead of snapshots,
    longer and longer trainings up to `seconds` (hnerf/study/benchmark/convergence.py)."""

    title: str
    notes: tuple[str, ...] = ()  # for the reader, for example about what is left out
    claims: tuple[Claim, ...] = ()
    seconds: float | None = Field(default=None, gt=0)
    snapshots: int = Field(default=4, ge=0, le=12)
    until_flat: bool = False
    sweep: Literal["cameras", "frames"] | None = None  # what differs between the variants; drawn as a separate chart
    methods: tuple[str, ...] = Field(min_length=1)
    variants: dict[str, Variant] = Field(min_length=1)
    scoring: ScoringSettings = ScoringSettings()

    @model_validator(mode="after")
    def _claims_of_a_sweep_have_one(self) -> Self:
        for claim in self.claims:
            if claim.check in ("more_is_better", "loses_least") and not self.sweep:
                raise ValueError(f"claims: {claim.check} requires a sweep")
        return self

    @model_validator(mode="after")
    def _flat_within_a_time(self) -> Self:
        if self.until_flat and (self.seconds is None or self.seconds < FIRST_S or self.snapshots):
            raise ValueError(f"until_flat: requires `snapshots: 0` and `seconds` of at least {FIRST_S:g}")
        return self

    def settings(self, method: str, seconds: float | None = None) -> Settings:
        """Return the settings of all stages. Training stops after `seconds`, by default the study's, and saves
        snapshots on the way. The preset's number of steps limits H-NeRF only, since it says how long H-NeRF needs; for
        a compared method, the question is what it reaches in its time."""
        settings, seconds = load_settings(method), seconds or self.seconds
        training = {"seconds": seconds, "snapshots_s": snapshot_times_s(seconds, self.snapshots)}
        if seconds and not settings.training.field.tunes_poses:
            training["steps"] = UNLIMITED_STEPS
        return settings.model_copy(update={"training": settings.training.model_copy(update=training)})

    def own_methods(self) -> list[str]:
        """Return the methods that are presets of H-NeRF."""
        return [name for name in self.methods if load_settings(name).training.field.tunes_poses]

    def restricted_to(self, names: Sequence[str], seconds: float | None) -> "BenchmarkStudy":
        """Return the study with these methods only, in the study's order, and this time limit. A method that the study
        does not have is run on every variant. Without names, the study keeps its methods, and without a limit its own
        limit. Raises InputError if the limit is below the first training of a study until curves are flat."""
        if self.until_flat and seconds and seconds < FIRST_S:
            raise InputError(f"--seconds {seconds:g}: the first training of this study takes {FIRST_S:g} s; give more")
        further = dict.fromkeys(name for name in names if name not in self.methods)
        methods = (*(name for name in self.methods if name in names or not names), *further)
        variants = {}
        for title, variant in self.variants.items():
            there = variant.methods or self.methods
            if kept := tuple(name for name in methods if name in there or name not in self.methods):
                variants[title] = variant.model_copy(update={"methods": kept})
        changes = {"methods": methods, "variants": variants, "seconds": seconds or self.seconds}
        return self.model_copy(update=changes)


def load_study(name: str) -> BenchmarkStudy:
    """Load a study by its name or its file's path. Raises InputError, in one line, if there is none or a key is not
    allowed."""
    path = named_file(name, STUDIES, "study")
    study = validated(BenchmarkStudy, read_yaml(path), path)
    for title, variant in study.variants.items():
        for method in variant.methods:
            if method not in study.methods:
                raise InputError(f"{path}: variants.{title}: no method {method}; there are {', '.join(study.methods)}")
    return study


def snapshot_times_s(seconds: float | None, count: int) -> tuple[float, ...]:
    """Return the time limit halved 1 to `count` times, in ascending order; without a limit, doublings of 15 s."""
    if seconds is None:
        return tuple(FIRST_SNAPSHOT_S * 2**k for k in range(count))
    return tuple(seconds / 2**k for k in range(count, 0, -1))


def _at_least(count: int, items: Sequence, what: str) -> Sequence:
    if len(items) < count:
        raise InputError(f"the capture has {len(items)} {what}, not {count}")
    return items

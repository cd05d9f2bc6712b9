"""Every setting, typed, frozen, with units in the names. Unknown keys are refused.

A preset is a YAML file under `configs/`; `load_settings("fast", ["training.seconds=60"])` reads one and overrides it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt, ValidationError, model_validator

from hnerf.errors import InputError

S = TypeVar("S", bound=BaseModel)

CONFIGS = Path(__file__).parent.parent / "configs"


class Section(BaseModel):
    """One stage's settings: frozen, no unknown keys, no values outside their type."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class CaptureSettings(Section):
    max_side_px: int = Field(default=1024, ge=16)  # longer images are shrunk at the door
    max_frames: int = Field(default=60, ge=1)  # training frames where no capture.toml chooses; evenly strided


class PerformerSettings(Section):
    """The synthetic capture that `hnerf synth` writes; no stage of a run reads it."""

    seed: int = Field(default=0, ge=0)
    size_px: int = Field(default=256, ge=16, le=4096)
    train_cameras: int = Field(default=4, ge=1)  # on a ring, at equal angles
    test_cameras: int = Field(default=2, ge=0)  # half-way between two of those each, evenly spread
    train_frames: int = Field(default=20, ge=1)
    novel_pose_frames: int = Field(default=6, ge=0)
    fps: float = Field(default=10.0, gt=0)

    @model_validator(mode="after")
    def _one_test_camera_in_a_gap(self) -> Self:
        if self.test_cameras > self.train_cameras:
            raise ValueError("test_cameras: there is one at most between two training cameras")
        return self


class DetectionSettings(Section):
    source: Literal["recording", "network", "both"] | None = None  # None: the recording's own keypoints if it has any
    size: Literal["heavy", "full", "lite"] = "heavy"  # of the landmark network


class CalibrationSettings(Section):
    max_residual_px: float = Field(default=5.0, gt=0)  # median a camera may show, more of a person taller than 357 px
    min_improvement: float = Field(default=0.02, ge=0, lt=1)  # share by which held-out frames must gain to accept it


class SegmentationSettings(Section):
    shadow_chroma: float = Field(default=0.01, gt=0)  # spread of log colour ratios in a shadow, beyond noise
    darkest_shadow: float = Field(default=0.3, gt=0, lt=1)  # brightness left in the deepest shadow
    reach: float = Field(default=0.13, gt=0)  # how far clothes and hair reach from limbs, in heights of the person
    model: Path | None = None  # ONNX file of a learned segmentation, used in place of plates; given masks come first
    rounds: int = Field(default=3, ge=1)  # of fit and segmentation at most, where neither masks nor plates are given
    still_px: float = Field(default=0.5, gt=0)  # mean movement of the masks' edges from which rounds end


class FitSettings(Section):
    """Standard deviations, unless said otherwise. Shape values are anny's: phenotypes in [0, 1], local changes in
    [-1, 1]; SMPL's have their own, 1."""

    body_model: Literal["anny"] | Path = "anny"  # or an SMPL, SMPL-H or SMPL-X file (.npz, .pkl) of one's own
    keypoint_m: float = Field(default=0.02, gt=0)  # of a keypoint seen with full confidence
    keypoint_outlier_m: float = Field(default=0.15, gt=0)  # distance at which a keypoint's pull fades
    offset_m: float = Field(default=0.02, gt=0)  # between the detector's idea of a keypoint and the body model's
    stature_m: float = Field(default=1.72, gt=0)  # mean height of people
    stature_std_m: float = Field(default=0.08, gt=0)
    phenotype_std: float = Field(default=0.25, gt=0)
    local_change_spread: float = Field(default=0.3, gt=0)
    acceleration_mps2: float = Field(default=10.0, gt=0)  # of the trunk; hands and feet three to four times as much
    inside_m: float = Field(default=0.008, gt=0)  # of a mask's edge inside the body
    outside_m: float = Field(default=0.02, gt=0)  # of a mask's edge outside the body
    clothing_m: float = Field(default=0.08, gt=0)  # distance at which cloth and hair no longer pull the body outwards
    spacing_m: float = Field(default=0.03, gt=0)  # between the points of an outline
    contour_steps: int = Field(default=10, ge=1)


class FastFieldSettings(Section):
    """The fast machinery: shell, grids and small networks. What is 0, or has no cells, the scene decides
    (hnerf/training/auto_settings.py)."""

    outer_m: float = Field(default=0.0, ge=0)  # the shell's thickness outside the body
    inner_m: float = Field(default=0.0, ge=0)  # and inside
    shell_cell_m: float = Field(default=0.015, gt=0)
    samples: int = Field(default=0, ge=0)
    geometry_cells: tuple[PositiveInt, ...] = ()  # on the box's longest side, a level each
    colour_cells: tuple[PositiveInt, ...] = ()
    channels: int = Field(default=4, ge=1)
    width: int = Field(default=64, ge=1)
    pose_width: int = Field(default=0, ge=0)
    nodes: int = Field(default=0, ge=0)  # of each frame's deformation
    grid_learning_rate: float = Field(default=5e-2, gt=0)
    network_learning_rate: float = Field(default=1e-2, gt=0)
    deformation_learning_rate: float = Field(default=1e-3, ge=0)  # metres; 0: frames do not deform the body


class PaperFieldSettings(Section):
    """The paper's machinery; distances inside it are in scene units."""

    scene_m: float = Field(default=2.5, gt=0)  # half the scene's edge, the unit of sigma_h and gamma
    samples: int = Field(default=256, ge=2)  # coarse, and as many fine
    box_samples: int = Field(default=0, ge=0)  # of the coarse ones, within the person's box alone
    rays: Literal["image", "box"] = "image"  # train on all pixels, or on those whose rays meet the person's box
    gamma: float = Field(default=200.0, gt=0)
    learning_rate: float = Field(default=1e-3, gt=0)
    root_condition: bool = True  # colour depends on T
    view_octaves: int = Field(default=0, ge=0)  # of the encoding of v
    bf16: bool = False  # the networks' layers but the last ones multiply in bfloat16

    @model_validator(mode="after")
    def _some_samples_lie_outside_the_box(self) -> Self:
        if self.box_samples >= self.samples:
            raise ValueError(f"box_samples is {self.box_samples}: set fewer than the {self.samples} samples")
        return self


class NerfSettings(Section):
    """NeRF, a compared method (hnerf/baselines/nerf.py)."""

    samples: int = Field(default=24, ge=2)  # coarse, and as many fine
    width: int = Field(default=64, ge=2)
    learning_rate: float = Field(default=5e-3, gt=0)


class IdrSettings(Section):
    """IDR, a compared method (hnerf/baselines/idr.py)."""

    samples: int = Field(default=32, ge=3)  # a ray, to find its least distance
    width: int = Field(default=64, ge=2)
    learning_rate: float = Field(default=1e-3, gt=0)


class NeuralBodySettings(Section):
    """NeuralBody, a compared method (hnerf/baselines/neural_body.py)."""

    samples: int = Field(default=32, ge=2)
    voxel_m: float = Field(default=0.015, gt=0)
    code_width: int = Field(default=16, ge=1)  # of a vertex
    channels: int = Field(default=32, ge=1)
    width: int = Field(default=64, ge=1)
    learning_rate: float = Field(default=5e-3, gt=0)


class NerfiesSettings(Section):
    """Nerfies, a compared method (hnerf/baselines/nerfies.py)."""

    samples: int = Field(default=24, ge=2)  # coarse, and as many fine
    width: int = Field(default=64, ge=2)  # of the template
    deformation_width: int = Field(default=64, ge=2)
    code_width: int = Field(default=8, ge=1)  # of a frame
    anneal_steps: int = Field(default=500, ge=1)  # until the deformation has all its octaves
    learning_rate: float = Field(default=5e-3, gt=0)


GeometryRoles = Literal["surface_leads", "print"]


class LossSettings(Section):
    """Weights of the nine losses in the form of hnerf/training/losses.py, and their constants."""

    reconstruction: float = Field(default=1.0, ge=0)
    mask: float = Field(default=1.0, ge=0)
    blend: float = Field(default=0.1, ge=0)
    geometry: float = Field(default=0.02, ge=0)
    segmentation: float = Field(default=0.02, ge=0)
    eikonal: float = Field(default=1e-6, ge=0)
    residual: float = Field(default=5e-4, ge=0)
    fit: float = Field(default=1.0, ge=0)
    increment: float = Field(default=0.02, ge=0)
    elastic: float = Field(default=0.0, ge=0)  # not the paper's: of a deformation, as `fast` and Nerfies have
    eta: float = Field(default=1.0, ge=0)  # of the surroundings in blend; 0.25 where floor or furniture is near
    density_threshold: float = Field(default=50.0, gt=0)  # sigma_h, per scene unit
    geometry_roles: GeometryRoles = "surface_leads"  # whether geom moves the density alone, or both, as printed
    density_steepness: float = Field(default=0.02, gt=0)  # lambda; docs/method.md says why


H_NERF = ("fast", "paper")  # machineries; the others are compared methods


class TrainingSettings(Section):
    machinery: Literal["fast", "paper", "nerf", "idr", "neural_body", "nerfies"] = "fast"
    fast: FastFieldSettings = FastFieldSettings()
    paper: PaperFieldSettings = PaperFieldSettings()
    nerf: NerfSettings = NerfSettings()
    idr: IdrSettings = IdrSettings()
    neural_body: NeuralBodySettings = NeuralBodySettings()
    nerfies: NerfiesSettings = NerfiesSettings()
    losses: LossSettings = LossSettings()
    steps: int = Field(default=0, ge=0)  # 0: the scene decides
    seconds: float | None = Field(default=None, gt=0)  # at which the field's training ends if its steps have not
    novel_pose_steps: int = Field(default=100, ge=0)  # what belongs to novel frames, against the finished field
    frames_per_step: int = Field(default=8, ge=1)
    rays_per_frame: int = Field(default=192, ge=1)  # of so many frames; where there are fewer, they share these rays
    pose_learning_rate: float = Field(default=5e-4, ge=0)  # 0 keeps the fitted poses and shape
    one_posture: bool | None = None  # in all training frames: only the root moves; None: the scene decides
    absorb_steps: int = Field(default=100, ge=1)  # between exact updates of the posed bodies; also at checkpoints
    noise: float = Field(default=0.1, ge=0)  # on theta, T and v
    checkpoint_steps: int = Field(default=100, ge=1)
    snapshots_s: tuple[PositiveFloat, ...] = ()  # when the subject is saved as it stands, below `snapshots/`
    processes: int = Field(default=0, ge=0)  # 0: one a GPU, or one
    memory_gib: float | None = Field(default=None, gt=0)  # a process, for the rays of a step; None: what is free
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _only_h_nerf_tunes_poses(self) -> Self:
        if self.pose_learning_rate and self.machinery not in H_NERF:
            raise ValueError(f"{self.machinery} does not tune poses: set pose_learning_rate to 0")
        return self


class EvaluationSettings(Section):
    max_meshes: int = Field(default=4, ge=1)  # a split
    max_images: int | None = Field(default=None, ge=1)  # a split; None: all
    report_rows: int = Field(default=3, ge=1)  # frames shown of each split
    holdout: str | None = None  # a camera, or "each" in turn, that a second, scored field goes without; no test cameras


class AssetSettings(Section):
    grid_cells: int = Field(default=256, ge=16)  # of marching cubes, on the longest side
    faces: int = Field(default=20_000, ge=100)
    texture_px: int = Field(default=1024, ge=16)
    texture_poses: int = Field(default=3, ge=1)  # of the capture; each texel takes the median colour


class Settings(Section):
    """One section a stage; a stage's cache key depends on its own section only."""

    capture: CaptureSettings = CaptureSettings()
    detection: DetectionSettings = DetectionSettings()
    calibration: CalibrationSettings = CalibrationSettings()
    segmentation: SegmentationSettings = SegmentationSettings()
    fit: FitSettings = FitSettings()
    training: TrainingSettings = TrainingSettings()
    evaluation: EvaluationSettings = EvaluationSettings()
    asset: AssetSettings = AssetSettings()


def load_settings(preset: str, overrides: Sequence[str] = ()) -> Settings:
    """Settings from a preset's name or a YAML file's path, with overrides like "training.steps=100".

    Raises InputError with one line if the preset is unknown or no YAML, or a key or value is not allowed.
    """
    path = named_file(preset, CONFIGS, "preset", "presets")
    return overridden(validated(Settings, read_yaml(path), path), overrides)


def overridden(settings: S, overrides: Sequence[str]) -> S:
    """Settings with overrides like "training.steps=100"; InputError, one line, for a key or value not allowed."""
    tree = settings.model_dump()
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals:
            raise InputError(f"--set {override}: write it as section.name=value")
        *sections, leaf = key.split(".")
        node = tree
        for section in sections:
            node = node.setdefault(section, {})
            if not isinstance(node, dict):
                raise InputError(f"--set {override}: {section} is not a section")
        node[leaf] = _parsed(value, f"--set {override}")
    message = " ".join(f"--set {override}" for override in overrides)
    return validated(type(settings), tree, message) if overrides else settings


def with_changes(settings: Settings, path: Path) -> Settings:
    """Settings with those values replaced that a YAML file names, such as one of `configs/ablations/`.

    Raises InputError with one line if the file is no YAML, or a key or value is not allowed.
    """
    return validated(Settings, _merged(settings.model_dump(), read_yaml(path)), path)


def _merged(tree: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """A tree with the leaves of another put in."""
    merged = dict(tree)
    for name, value in changes.items():
        both = isinstance(tree.get(name), dict) and isinstance(value, dict)
        merged[name] = _merged(tree[name], value) if both else value
    return merged


def named_file(name: str, folder: Path, one: str, many: str) -> Path:
    """The YAML file of this name in a folder, or else at this path; InputError, which lists those of the folder."""
    path = folder / f"{name}.yaml" if (folder / f"{name}.yaml").exists() else Path(name)
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.yaml")))
        raise InputError(f"{name}: no such {one} or file; {many} are {known}")
    return path


def read_yaml(path: Path) -> dict[str, Any]:
    """The keys and values of a YAML file, none of an empty one; InputError, one line, where it holds no such."""
    tree = _parsed(path.read_bytes(), str(path))
    if not isinstance(tree, dict | None):
        raise InputError(f"{path}: holds no keys and values; write it as `name: value`")
    return tree or {}


def _parsed(text: str | bytes, source: str) -> Any:
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: a date such as 2026-13-01
        raise InputError(f"{source}: is not YAML ({' '.join(str(error).split())}); correct it") from None


def validated(kind: type[S], tree: Any, source: Path | str) -> S:
    """A model from the tree that a YAML or TOML file holds; InputError, one line with source and key, on what is
    wrong."""
    try:
        return kind.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{source}: {'.'.join(map(str, first['loc']))}: {first['msg']}; correct it") from None

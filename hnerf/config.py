"""All settings: typed, frozen, with units in their names; unknown keys are refused.

A preset is a YAML file under `configs/`; `load_settings("fast", ["training.seconds=60"])` reads one and overrides it.
"""

import difflib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt, ValidationError, model_validator

from hnerf.errors import InputError
from hnerf.strict_yaml import MAX_DEPTH, parse_yaml, parse_yaml_strings

S = TypeVar("S", bound=BaseModel)

CONFIGS = Path(__file__).parent.parent / "configs"
Seed = Annotated[int, Field(ge=0, lt=2**63)]  # of any generator
MAX_BYTES = 65_536  # of a file of settings
CLOSE = 0.7  # of difflib: keys that are taken for misspelled ones


class Section(BaseModel):
    """Settings of one stage: frozen, without unknown keys or values outside their type.

    excluded_from_key: names of those that the stage's cache key leaves out, since its result does not depend on them.
    """

    excluded_from_key: ClassVar[tuple[str, ...]] = ()
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def key_values(self) -> dict[str, Any]:
        """Return the settings on which the stage's result depends, for its cache key."""
        return self.model_dump(exclude=set(self.excluded_from_key))


class CaptureSettings(Section):
    """Settings of ingestion."""

    max_side_px: int = Field(default=1024, ge=16)  # images with a longer side are shrunk when they are ingested
    max_frames: int = Field(default=60, ge=1)  # training frames, evenly strided, unless capture.toml chooses


class SyntheticSettings(Section):
    """Settings of the synthetic capture that `hnerf synth` writes; no stage of a run reads them."""

    seed: Seed = 0
    size_px: int = Field(default=256, ge=16, le=4096)
    train_cameras: int = Field(default=4, ge=1)  # on a ring, at equal angles
    test_cameras: int = Field(default=2, ge=0)  # each half-way between two of those, evenly spaced
    train_frames: int = Field(default=20, ge=1)
    novel_pose_frames: int = Field(default=6, ge=0)
    fps: float = Field(default=10.0, ge=0.01, le=10_000)  # as capture.toml may state

    @model_validator(mode="after")
    def _one_test_camera_in_a_gap(self) -> Self:
        if self.test_cameras > self.train_cameras:
            raise ValueError("test_cameras: one at most between two training cameras; lower it")
        return self


class DetectionSettings(Section):
    source: Literal["recording", "network", "both"] | None = None  # None: see docs/formats.md, Keypoints
    size: Literal["heavy", "full", "lite"] = "heavy"  # of the landmark network
    hands: Literal["auto", "none"] = "auto"  # auto: find the subject's where networks are installed; 0.04 s an image


class CalibrationSettings(Section):
    """Settings of the calibration check and of the refinement of cameras."""

    max_residual_px: float = Field(default=5.0, gt=0)  # a camera's median at most; more for a person taller than 357 px
    min_improvement: float = Field(default=0.02, ge=0, lt=1)  # share by which held-out residuals must fall to accept it


class SegmentationSettings(Section):
    """Settings of the masks."""

    excluded_from_key: ClassVar[tuple[str, ...]] = ("rounds", "still_px")  # of the flow, which repeats the stage
    shadow_chroma: float = Field(default=0.01, gt=0)  # std of log colour ratios in a shadow, beyond noise
    darkest_shadow: float = Field(default=0.3, gt=0, lt=1)  # share of the brightness that is left in the deepest shadow
    reach: float = Field(default=0.13, gt=0)  # of clothes and hair from limbs, in heights of the person
    model: Path | None = None  # ONNX file of a segmentation network, used in place of plates; given masks come first
    rounds: int = Field(default=3, ge=1)  # at most, of fit and segmentation, where neither masks nor plates are given
    still_px: float = Field(default=0.5, gt=0)  # rounds end when the masks' edges move less than this on average


class FitSettings(Section):
    """Settings of the body fit: standard deviations, unless said otherwise.

    Shape values are anny's: phenotypes in [0, 1], local changes in [-1, 1]. SMPL's betas have a standard deviation of
    their own, 1.
    """

    body_model: Literal["anny"] | Path = "anny"  # or an SMPL, SMPL-H or SMPL-X file (.npz, .pkl) of one's own
    keypoint_m: float = Field(default=0.02, gt=0)  # of a keypoint seen with full confidence
    keypoint_outlier_m: float = Field(default=0.15, gt=0)  # beyond it a keypoint counts as an outlier
    offset_m: float = Field(default=0.02, gt=0)  # between where the detector and the body model place a keypoint
    stature_m: float = Field(default=1.72, gt=0)  # mean height of people
    stature_std_m: float = Field(default=0.08, gt=0)
    phenotype_std: float = Field(default=0.25, gt=0)
    local_change_std: float = Field(default=0.3, gt=0)
    acceleration_mps2: float = Field(default=10.0, gt=0)  # of the trunk; hands and feet three to four times as much
    inside_m: float = Field(default=0.008, gt=0)  # of residuals where the mask's edge lies inside the body
    outside_m: float = Field(default=0.02, gt=0)  # of residuals where it lies outside the body
    clothing_m: float = Field(default=0.08, gt=0)  # beyond it cloth and hair no longer pull the body outwards
    spacing_m: float = Field(default=0.03, gt=0)  # between neighbouring points of an outline
    contour_steps: int = Field(default=10, ge=1)


class FieldSettings(Section):
    """Settings that all fields have.

    tunes_poses: whether training refines poses and shape, as H-NeRF's fields do; compared methods take them as fitted.
    models_motion: a field without it needs a single training frame. no_new_poses: the reason why it cannot render a
    pose that it was not trained on, empty where it can.
    """

    tunes_poses: ClassVar[bool] = False
    models_motion: ClassVar[bool] = True
    no_new_poses: ClassVar[str] = ""
    kind: str
    scene_m: float = Field(default=2.5, gt=0)  # half the scene's edge: the unit of sigma_h, gamma and of the root's T


class FastFieldSettings(FieldSettings):
    """Settings of the field `fast`: shell, grids and small networks. Values that are 0 or empty by default are chosen
    from the scene (hnerf/training/auto_settings.py)."""

    tunes_poses: ClassVar[bool] = True
    kind: Literal["fast"] = "fast"
    outer_m: float = Field(default=0.0, ge=0)  # thickness of the shell outside the body
    inner_m: float = Field(default=0.0, ge=0)  # thickness of the shell inside the body
    shell_cell_m: float = Field(default=0.015, gt=0)
    samples: int = Field(default=0, ge=0)
    geometry_cells: tuple[PositiveInt, ...] = ()  # of each level, on the box's longest side
    colour_cells: tuple[PositiveInt, ...] = ()
    channels: int = Field(default=4, ge=1)
    width: int = Field(default=64, ge=1)
    pose_width: int = Field(default=0, ge=0)
    nodes: int = Field(default=0, ge=0)  # of each frame's deformation graph
    grid_learning_rate: float = Field(default=5e-2, gt=0)
    network_learning_rate: float = Field(default=1e-2, gt=0)
    deformation_learning_rate: float = Field(default=1e-3, ge=0)  # metres; 0: frames do not deform the body


class PaperFieldSettings(FieldSettings):
    """Settings of the field `paper`, as published; distances inside it are in scene units."""

    tunes_poses: ClassVar[bool] = True
    kind: Literal["paper"] = "paper"
    samples: int = Field(default=256, ge=2)  # coarse, and as many fine
    box_samples: int = Field(default=0, ge=0)  # of the coarse samples, those placed only inside the person's box
    rays: Literal["image", "box"] = "image"  # train on all pixels, or on those whose rays meet the person's box
    gamma: float = Field(default=200.0, gt=0)
    learning_rate: float = Field(default=1e-3, gt=0)
    root_condition: bool = True  # colour depends on T
    view_octaves: int = Field(default=0, ge=0)  # of the encoding of v
    bf16: bool = False  # all layers of the networks but the last multiply in bfloat16

    @model_validator(mode="after")
    def _some_samples_lie_outside_the_box(self) -> Self:
        if self.box_samples >= self.samples:
            raise ValueError(f"box_samples is {self.box_samples}: set it below samples, {self.samples}")
        return self


class NerfSettings(FieldSettings):
    """Settings of NeRF, a compared method (hnerf/baselines/nerf.py)."""

    models_motion: ClassVar[bool] = False
    no_new_poses: ClassVar[str] = "NeRF models one moment"
    kind: Literal["nerf"] = "nerf"
    samples: int = Field(default=24, ge=2)  # coarse, and as many fine
    width: int = Field(default=64, ge=2)
    learning_rate: float = Field(default=5e-3, gt=0)


class IdrSettings(FieldSettings):
    """Settings of IDR, a compared method (hnerf/baselines/idr.py)."""

    models_motion: ClassVar[bool] = False
    no_new_poses: ClassVar[str] = "IDR models one moment"
    kind: Literal["idr"] = "idr"
    samples: int = Field(default=32, ge=3)  # per ray, to find its least distance
    width: int = Field(default=64, ge=2)
    learning_rate: float = Field(default=1e-3, gt=0)


class NeuralBodySettings(FieldSettings):
    """Settings of NeuralBody, a compared method (hnerf/baselines/neural_body.py)."""

    kind: Literal["neural_body"] = "neural_body"
    samples: int = Field(default=32, ge=2)
    voxel_m: float = Field(default=0.015, gt=0)
    code_width: int = Field(default=16, ge=1)  # of each vertex's latent code
    channels: int = Field(default=32, ge=1)
    width: int = Field(default=64, ge=1)
    learning_rate: float = Field(default=5e-3, gt=0)


class NerfiesSettings(FieldSettings):
    """Settings of Nerfies, a compared method (hnerf/baselines/nerfies.py)."""

    no_new_poses: ClassVar[str] = "Nerfies has no pose to set: it replays the moments it was trained on"
    kind: Literal["nerfies"] = "nerfies"
    samples: int = Field(default=24, ge=2)  # coarse, and as many fine
    width: int = Field(default=64, ge=2)  # of the template network
    deformation_width: int = Field(default=64, ge=2)
    code_width: int = Field(default=8, ge=1)  # of each frame's latent code
    anneal_share: float = Field(default=1 / 3, gt=0, le=1)  # of training, until the deformation uses all octaves
    learning_rate: float = Field(default=1e-3, gt=0)  # as published; with 5e-3, it comes apart after minutes


GeometryRoles = Literal["surface_leads", "print"]


class LossSettings(Section):
    """Weights of the losses in hnerf/training/losses.py, and their constants."""

    reconstruction: float = Field(default=1.0, ge=0)
    mask: float = Field(default=1.0, ge=0)
    blend: float = Field(default=0.1, ge=0)
    geometry: float = Field(default=0.02, ge=0)
    segmentation: float = Field(default=0.02, ge=0)
    eikonal: float = Field(default=1e-6, ge=0)
    residual: float = Field(default=5e-4, ge=0)
    fit: float = Field(default=1.0, ge=0)
    increment: float = Field(default=0.02, ge=0)
    elastic: float = Field(default=0.0, ge=0)  # not in the paper: regularises the deformations of `fast` and Nerfies
    floor: float = Field(default=0.0, ge=0)  # not in the paper; per metre: keeps the surface above the ground
    fog: float = Field(default=0.0, ge=0)  # not in the paper: the box is empty beside the person
    eta: float = Field(default=1.0, ge=0)  # weight of the surroundings in blend; 0.25 where floor or furniture is near
    density_threshold: float = Field(default=50.0, gt=0)  # sigma_h, per scene unit
    geometry_roles: GeometryRoles = "surface_leads"  # whether geometry moves the density alone, or both
    density_steepness: float = Field(default=0.02, gt=0)  # lambda; docs/findings.md, Published networks, says why


AnyFieldSettings = (
    FastFieldSettings | PaperFieldSettings | NerfSettings | IdrSettings | NeuralBodySettings | NerfiesSettings
)


class TrainingSettings(Section):
    """Settings of training: the field with its own settings, the losses and the optimisation."""

    excluded_from_key: ClassVar[tuple[str, ...]] = ("processes", "memory_gib")  # but for the order of sums
    field: AnyFieldSettings = Field(default=FastFieldSettings(), discriminator="kind")
    losses: LossSettings = LossSettings()
    steps: int = Field(default=0, ge=0)  # 0: chosen from the scene
    seconds: float | None = Field(default=None, gt=0)  # limit on the time for the field's steps; None: no limit
    novel_pose_steps: int = Field(default=100, ge=0)  # for the poses of novel frames, against the finished field
    frames_per_step: int = Field(default=8, ge=1)
    rays_per_frame: int = Field(default=192, ge=1)  # with frames_per_step frames; fewer share these rays
    pose_learning_rate: float = Field(default=5e-4, ge=0)  # 0 keeps the fitted poses and shape
    one_posture: bool | None = None  # in all training frames, so that only the root moves; None: chosen from the scene
    ground: bool | None = None  # the ground is at height 0; None: chosen from the fitted feet
    absorb_steps: int = Field(default=100, ge=1)  # between exact updates of the posed bodies
    noise: float = Field(default=0.1, ge=0)  # std, on theta, T and v
    checkpoint_steps: int = Field(default=100, ge=1)
    snapshots_s: tuple[PositiveFloat, ...] = ()  # times at which the subject is also saved, below `snapshots/`
    processes: int = Field(default=0, ge=0)  # 0: one for each GPU, or one without any
    memory_gib: float | None = Field(default=None, gt=0)  # per process, for the rays of a step; None: what is free
    seed: Seed = 0

    @model_validator(mode="after")
    def _compared_methods_tune_no_poses(self) -> Self:
        if self.pose_learning_rate and not self.field.tunes_poses:
            raise ValueError(f"{self.field.kind} does not tune poses: set pose_learning_rate to 0")
        return self

    @model_validator(mode="after")
    def _fog_needs_a_background(self) -> Self:
        if self.losses.fog and self.field.kind != "paper":
            raise ValueError(f"{self.field.kind} does not model the background: set losses.fog to 0")
        return self


class EvaluationSettings(Section):
    """Settings of the evaluation and its report."""

    excluded_from_key: ClassVar[tuple[str, ...]] = ("holdout",)  # of the flow, which names the camera to the stage
    max_meshes: int = Field(default=4, ge=1)  # per split
    max_images: int | None = Field(default=None, ge=1)  # per split; None: all
    report_rows: int = Field(default=3, ge=1)  # frames shown of each split
    holdout: str | None = None  # a camera, or "each" in turn, that a second training leaves out and is scored on


class AssetSettings(Section):
    """Settings of the exported assets."""

    grid_cells: int = Field(default=256, ge=16)  # of marching cubes, on the longest side
    topology: Literal["registered", "captured", "both"] = "registered"  # the body's mesh; marching cubes'; in USD, both
    faces: int = Field(default=20_000, ge=100)  # of the captured mesh; the registered one has the body model's
    level_faces: tuple[PositiveInt, ...] = (10_000, 5_000)  # triangles, at most, of each lower level of detail
    texture_px: int = Field(default=1024, ge=16)
    texture_poses: int = Field(default=3, ge=1)  # of the capture, whose median is the field's colour of a texel
    photograph_frames: int = Field(default=16, ge=0)  # whose training photographs make the texture; 0: the field alone
    normal_map_px: int = Field(default=0, ge=0)  # side of the normal map; 0: none, since it shows the grids' cells
    correctives: int = Field(default=16, ge=0, le=64)  # components of what frames have beyond skinning
    bones: Literal["along", "identity"] = "along"  # joints' axes at rest: Y along the bone, or those of the stage
    splats: int = Field(default=0, ge=0, le=1_000_000)  # Gaussian splats on the surface, in files of their own; 0: none
    allow_poor: bool = False  # hand over an asset that is more than 4 dB below its field, too
    version: str = "1"  # of the asset, as its assetInfo says
    licence: str = ""  # of the asset, as its assetInfo says


class LimitSettings(Section):
    """Time limits: how long a stage may make no progress before it is ended. No result depends on them."""

    stage_s: float = Field(default=1800.0, gt=0)  # whatever its size, and
    image_s: float = Field(default=5.0, ge=0)  # for each image: frames times cameras


class Settings(Section):
    """All settings of a run, one section a stage, whose cache key depends on its own section only; and its limits."""

    capture: CaptureSettings = CaptureSettings()
    detection: DetectionSettings = DetectionSettings()
    calibration: CalibrationSettings = CalibrationSettings()
    segmentation: SegmentationSettings = SegmentationSettings()
    fit: FitSettings = FitSettings()
    training: TrainingSettings = TrainingSettings()
    evaluation: EvaluationSettings = EvaluationSettings()
    asset: AssetSettings = AssetSettings()
    limits: LimitSettings = LimitSettings()


def load_settings(preset: str, overrides: Sequence[str] = ()) -> Settings:
    """Return the settings of a preset's name or a YAML file's path, with overrides like "training.steps=100".

    Raises InputError with one line if there is no such preset, it is not YAML, or a key or value is not allowed.
    """
    path = named_file(preset, CONFIGS, "preset", "presets")
    return overridden(validated(Settings, preset_tree(path), path), overrides)


def preset_tree(path: Path) -> dict[str, Any]:
    """Return the tree in a preset's file, merged over the preset under configs/ that it names as `based_on`, if any."""
    tree = read_yaml(path)
    base = tree.pop("based_on", None)
    return tree if base is None else _merged(read_yaml(named_file(str(base), CONFIGS, "preset", "presets")), tree)


def overridden(settings: S, overrides: Sequence[str]) -> S:
    """Return settings with overrides like "training.steps=100"; raises InputError, one line, for a key or value that is
    not allowed."""
    tree = settings.model_dump()
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals:
            raise InputError(f"--set {override}: write it as section.name=value")
        change = parse_yaml(value, f"--set {override}")
        parts = key.split(".")
        if len(parts) > MAX_DEPTH:
            raise InputError(f"--set {key}: no such key; `hnerf settings` lists them")
        if change is not None and _is_text(settings, parts):
            change = parse_yaml_strings(value)  # "1.10" is a version, and "03" a camera
        for part in reversed(parts):
            change = {part: change}
        tree = _merged(tree, change)
    message = " ".join(f"--set {override}" for override in overrides)
    return validated(type(settings), tree, message) if overrides else settings


def _is_text(settings: BaseModel, key: Sequence[str]) -> bool:
    """Return whether the setting with this key, section by section, takes any text."""
    section: object = settings
    for part in key[:-1]:
        section = dict(section).get(part) if isinstance(section, BaseModel) else None
    field = type(section).model_fields.get(key[-1]) if isinstance(section, BaseModel) else None
    return field is not None and field.annotation in (str, str | None)


def with_changes(settings: Settings, path: Path) -> Settings:
    """Return settings with the values replaced that a YAML file names, such as one of `configs/ablations/`.

    Raises InputError with one line if the file is not YAML, or a key or value is not allowed.
    """
    return validated(Settings, _merged(settings.model_dump(), read_yaml(path)), path)


def _merged(tree: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return a tree with the leaves of another replaced or added; a section whose `kind` changes keeps nothing of the
    previous kind."""
    merged = dict(tree)
    for name, value in changes.items():
        before = tree.get(name)
        if isinstance(before, dict) and isinstance(value, dict) and value.get("kind") in (None, before.get("kind")):
            merged[name] = _merged(before, value)
        else:
            merged[name] = value
    return merged


def named_file(name: str, folder: Path, one: str, many: str) -> Path:
    """Return the path of the YAML file of this name in a folder, or else `name` itself as a path. Raises InputError,
    which lists the files of the folder, where there is neither."""
    with suppress(OSError, ValueError):  # of a name that is too long, or holds a NUL
        for path in (folder / f"{name}.yaml", Path(name)):
            if path.is_file():
                return path
    known = ", ".join(sorted(p.stem for p in folder.glob("*.yaml")))
    raise InputError(f"{name[:80]}: no such {one} or file; {many} are {known}")


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the keys and values of a YAML file, an empty dictionary for an empty file. Raises InputError, one line,
    where it holds anything else, or more than settings need."""
    with path.open("rb") as file:
        text = file.read(MAX_BYTES + 1)
    if len(text) > MAX_BYTES:
        raise InputError(f"{path}: more than {MAX_BYTES} bytes; give a YAML file of settings")
    tree = parse_yaml(text, path)
    if not isinstance(tree, dict | None):
        raise InputError(f"{path}: does not hold keys and values; write lines like `name: value`")
    return tree or {}


def validated(kind: type[S], tree: Any, source: Path | str) -> S:
    """Return a model validated from the tree that a YAML or TOML file holds. Raises InputError, one line with source
    and key, on the first value that is wrong."""
    try:
        return kind.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        key: list[str] = []
        node = tree
        for part in first["loc"]:
            with suppress(LookupError, TypeError):  # kinds of a union are named, too, and are no keys of the tree
                node = node[part]
                key.append(str(part))
        key += [str(part) for part in first["loc"][-1:] if first["type"] == "missing"]
        wrong, advice = first["msg"].removeprefix("Value error, "), "correct it"
        if first["type"] == "extra_forbidden":
            close = difflib.get_close_matches(key[-1], _keys(kind.model_json_schema()), 1, CLOSE)
            wrong, advice = "no such key", f"did you mean {close[0]}?" if close else "remove it, or correct its name"
            if close == key[-1:]:
                advice = "it belongs in another section"
        where = ": ".join([str(source), ".".join(key)] if key else [str(source)])
        advised = wrong if "; " in wrong else f"{wrong}; {advice}"  # a model's own words may say what to do
        raise InputError(f"{where}: {advised}") from None


def _keys(schema: Mapping[str, Any]) -> set[str]:
    """Return all keys of a model and of those within it, by its JSON schema."""
    models = (schema, *schema.get("$defs", {}).values())
    return {key for model in models for key in model.get("properties", {})}

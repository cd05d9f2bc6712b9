"""All settings: typed, frozen, with units in their names; unknown keys are refused.

A preset is a YAML file under `configs/`; `load_settings("fast", ["training.seconds=60"])` reads one and overrides it.
"""

import difflib
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt, ValidationError, model_validator

from hnerf.errors import InputError
from hnerf.strict_yaml import MAX_DEPTH, parse_yaml

S = TypeVar("S", bound=BaseModel)

CONFIGS = Path(__file__).parent.parent / "configs"
Seed = Annotated[int, Field(ge=0, lt=2**63)]  # of any generator
MAX_BYTES = 65_536  # of a file of settings
NULLS = ("", "~", "null", "Null", "NULL")  # spellings that YAML reads as null
CLOSE = 0.7  # difflib ratio from which an unknown key counts as a misspelled one


class Section(BaseModel):
    """Settings of one stage: frozen, without unknown keys or values outside their type.

    excluded_from_key: names of settings that the stage's cache key leaves out, since its result does not depend on
    them.
    """

    excluded_from_key: ClassVar[tuple[str, ...]] = ()
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def key_values(self) -> dict[str, Any]:
        """Return the settings on which the stage's result depends, for its cache key."""
        return self.model_dump(exclude=set(self.excluded_from_key))


class CaptureSettings(Section):
    """Settings of ingestion."""

    max_side_px: int = Field(default=1024, ge=16)  # larger images are shrunk to this longest side at ingestion
    max_frames: int = Field(default=60, ge=1)  # training frames at most, evenly spaced, if capture.toml lists none


class SyntheticSettings(Section):
    """Settings of the synthetic capture that `hnerf synth` writes; no stage of a run reads them."""

    seed: Seed = 0  # of everything random
    size_px: int = Field(default=256, ge=16, le=4096)  # side of the square images
    train_cameras: int = Field(default=4, ge=1)  # on a ring, at equal angles
    test_cameras: int = Field(default=2, ge=0)  # each half-way between two training cameras
    train_frames: int = Field(default=20, ge=1)  # the first ones
    novel_pose_frames: int = Field(default=6, ge=0)  # frames with new poses, not trained on
    fps: float = Field(default=10.0, ge=0.01, le=10_000)  # frame rate

    @model_validator(mode="after")
    def _one_test_camera_in_a_gap(self) -> Self:
        if self.test_cameras > self.train_cameras:
            raise ValueError("test_cameras: one at most between two training cameras; lower it")
        return self


class DetectionSettings(Section):
    """Settings of the detection of people and hands."""

    excluded_from_key: ClassVar[tuple[str, ...]] = ("hands",)  # a stage of their own
    source: Literal["recording", "network", "both"] | None = None  # null: see docs/formats.md, From a network
    size: Literal["heavy", "full", "lite"] = "heavy"  # of the landmark network
    model: Path | None = None  # ONNX keypoint network; its keypoints replace those of the landmark network
    hands: Literal["auto", "none"] = "auto"  # auto: use the capture's hands, else find them if the network is installed


class CalibrationSettings(Section):
    """Settings of the calibration check and of the refinement of cameras."""

    max_residual_px: float = Field(default=5.0, gt=0)  # limit of a camera's median; more for persons over 357 px
    min_improvement: float = Field(default=0.02, ge=0, lt=1)  # a correction must lower held-out residuals by this share


class SegmentationSettings(Section):
    """Settings of the masks."""

    excluded_from_key: ClassVar[tuple[str, ...]] = ("rounds", "still_px")  # the flow uses them: it repeats the stage
    reach: float = Field(default=0.13, gt=0)  # of clothes and hair beyond the limbs, in body heights
    model: Path | None = None  # ONNX segmentation network; comes before clean plates, after given masks
    rounds: int = Field(default=3, ge=1)  # number of rounds at most, if there are neither masks nor plates
    still_px: float = Field(default=0.5, gt=0)  # rounds end when mask edges move less than this on average


class FitSettings(Section):
    """Settings of the body fit: standard deviations, unless said otherwise.

    Shape values are anny's: phenotypes in [0, 1], local changes in [-1, 1]. SMPL's betas have their own standard
    deviation, 1.
    """

    body_model: Literal["anny"] | Path = "anny"  # or the path of an SMPL, SMPL-H or SMPL-X file (.npz, .pkl)
    keypoint_m: float = Field(default=0.02, gt=0)  # std of a keypoint seen with full confidence
    keypoint_outlier_m: float = Field(default=0.15, gt=0)  # a keypoint farther off counts as an outlier
    offset_m: float = Field(default=0.02, gt=0)  # std of a keypoint's offset: detector minus body model
    stature_m: float = Field(default=1.72, gt=0)  # mean height of people
    stature_std_m: float = Field(default=0.08, gt=0)  # std of the height of people
    acceleration_mps2: float = Field(default=10.0, gt=0)  # std of the trunk; limbs have two to four times as much
    inside_m: float = Field(default=0.008, gt=0)  # std of residuals where the mask's edge lies inside the body
    outside_m: float = Field(default=0.02, gt=0)  # std of residuals where the mask's edge lies outside the body
    clothing_m: float = Field(default=0.08, gt=0)  # cloth and hair farther out do not pull the body outwards
    spacing_m: float = Field(default=0.03, gt=0)  # between neighbouring points of an outline
    contour_steps: int = Field(default=10, ge=1)  # steps of the fit to outlines


class FieldSettings(Section):
    """Settings that all fields have.

    tunes_poses: whether training refines poses and shape, as H-NeRF's fields do; compared methods take them as fitted.
    models_motion: whether the field can be trained on more than one frame. no_new_poses: the reason why it cannot
    render a pose that it was not trained on, empty if it can.
    """

    tunes_poses: ClassVar[bool] = False
    models_motion: ClassVar[bool] = True
    no_new_poses: ClassVar[str] = ""
    kind: str  # kind of field; decides the other settings of this section
    scene_m: float = Field(default=2.5, gt=0)  # half the scene's edge; unit of sigma_h, gamma and the root's T


class FastFieldSettings(FieldSettings):
    """Settings of the field `fast`: shell, grids and small networks. Values that are 0 or empty by default are chosen
    from the scene (hnerf/training/auto_settings.py)."""

    tunes_poses: ClassVar[bool] = True
    kind: Literal["fast"] = "fast"
    outer_m: float = Field(default=0.0, ge=0)  # thickness of the shell outside the body; 0: chosen from the scene
    inner_m: float = Field(default=0.0, ge=0)  # thickness of the shell inside the body; 0: chosen from the scene
    shell_cell_m: float = Field(default=0.015, gt=0)  # cell size of the shell's voxel grid
    spacing_m: float = Field(default=0.0, ge=0)  # of samples on a ray, at the end of training; 0: chosen
    geometry_cells: tuple[PositiveInt, ...] = ()  # per grid level, along the longest side; empty: chosen
    colour_cells: tuple[PositiveInt, ...] = ()  # the same for colour
    channels: int = Field(default=4, ge=1)  # features per grid node and level
    width: int = Field(default=64, ge=1)  # of the networks' layers
    pose_width: int = Field(default=0, ge=0)  # of the pose code; 0: chosen from the scene
    nodes: int = Field(default=0, ge=0)  # of each frame's deformation graph; 0: chosen from the scene
    grid_learning_rate: float = Field(default=5e-2, gt=0)  # of the features, at the start
    network_learning_rate: float = Field(default=1e-2, gt=0)  # at the start
    deformation_learning_rate: float = Field(default=1e-3, ge=0)  # in metres; 0: frames do not deform the body


class PaperFieldSettings(FieldSettings):
    """Settings of the field `paper`, as published; distances inside it are in scene units."""

    tunes_poses: ClassVar[bool] = True
    kind: Literal["paper"] = "paper"
    samples: int = Field(default=256, ge=2)  # coarse samples per ray, and as many fine ones
    box_samples: int = Field(default=0, ge=0)  # number of coarse samples that are spent on the person's box only
    rays: Literal["image", "box"] = "image"  # train on all pixels, or on those whose rays meet the person's box
    gamma: float = Field(default=200.0, gt=0)  # sharpness of the surface, per scene unit
    learning_rate: float = Field(default=1e-3, gt=0)  # at the start
    root_condition: bool = True  # whether colour depends on the root transform T
    view_octaves: int = Field(default=0, ge=0)  # of the encoding of the viewing direction
    bf16: bool = False  # multiply in bfloat16 in all layers but the last

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
    samples: int = Field(default=24, ge=2)  # coarse samples per ray, and as many fine ones
    width: int = Field(default=64, ge=2)  # of the networks' layers
    learning_rate: float = Field(default=5e-3, gt=0)  # at the start


class IdrSettings(FieldSettings):
    """Settings of IDR, a compared method (hnerf/baselines/idr.py)."""

    models_motion: ClassVar[bool] = False
    no_new_poses: ClassVar[str] = "IDR models one moment"
    kind: Literal["idr"] = "idr"
    samples: int = Field(default=32, ge=3)  # per ray, to find where it is nearest to the surface
    width: int = Field(default=64, ge=2)  # of the networks' layers
    learning_rate: float = Field(default=1e-3, gt=0)  # at the start


class NeuralBodySettings(FieldSettings):
    """Settings of NeuralBody, a compared method (hnerf/baselines/neural_body.py)."""

    kind: Literal["neural_body"] = "neural_body"
    samples: int = Field(default=32, ge=2)  # per ray
    voxel_m: float = Field(default=0.015, gt=0)  # edge of the finest voxels
    code_width: int = Field(default=16, ge=1)  # of each vertex's latent code
    channels: int = Field(default=32, ge=1)  # features of a voxel, at each of the coarser levels
    width: int = Field(default=64, ge=1)  # of the density and colour networks' layers
    learning_rate: float = Field(default=5e-3, gt=0)  # at the start


class NerfiesSettings(FieldSettings):
    """Settings of Nerfies, a compared method (hnerf/baselines/nerfies.py)."""

    no_new_poses: ClassVar[str] = "Nerfies has no pose to set: it replays the moments it was trained on"
    kind: Literal["nerfies"] = "nerfies"
    samples: int = Field(default=24, ge=2)  # coarse samples per ray, and as many fine ones
    width: int = Field(default=64, ge=2)  # of the template network's layers
    deformation_width: int = Field(default=64, ge=2)  # of the deformation network's layers
    code_width: int = Field(default=8, ge=1)  # of each frame's latent code
    anneal_share: float = Field(default=1 / 3, gt=0, le=1)  # share of training until all octaves are used
    learning_rate: float = Field(default=1e-3, gt=0)  # as published; with 5e-3, it comes apart after minutes


GeometryRoles = Literal["surface_leads", "print"]


class LossSettings(Section):
    """Weights of the losses in hnerf/training/losses.py, and their constants."""

    reconstruction: float = Field(default=1.0, ge=0)  # of the image's colours
    mask: float = Field(default=1.0, ge=0)  # of the person's colours by the density in the box alone
    blend: float = Field(default=0.1, ge=0)  # of colours whose opacity in the box is the SDF's
    geometry: float = Field(default=0.02, ge=0)  # of density and SDF that disagree
    segmentation: float = Field(default=0.02, ge=0)  # of the surface's outline against the masks
    eikonal: float = Field(default=1e-6, ge=0)  # of gradients of the SDF whose length is not 1
    residual: float = Field(default=5e-4, ge=0)  # of a surface inside the body's skin
    fit: float = Field(default=1.0, ge=0)  # of the body's own outline against the masks
    increment: float = Field(default=0.02, ge=0)  # of changes of poses and shape since the fit
    elastic: float = Field(default=0.0, ge=0)  # not in the paper: smooths the deformations of `fast` and Nerfies
    floor: float = Field(default=0.0, ge=0)  # per metre, not in the paper: keeps the surface above the ground
    fog: float = Field(default=0.0, ge=0)  # not in the paper: empties the box around the person
    eta: float = Field(default=1.0, ge=0)  # weight of the surroundings in blend; 0.25 near floor or furniture
    density_threshold: float = Field(default=50.0, gt=0)  # sigma_h, per scene unit
    geometry_roles: GeometryRoles = "surface_leads"  # whether geometry moves the density alone, or both
    density_steepness: float = Field(default=0.02, gt=0)  # lambda; see docs/findings.md, Published networks


AnyFieldSettings = (
    FastFieldSettings | PaperFieldSettings | NerfSettings | IdrSettings | NeuralBodySettings | NerfiesSettings
)


class TrainingSettings(Section):
    """Settings of training: the field with its own settings, the losses and the optimisation."""

    excluded_from_key: ClassVar[tuple[str, ...]] = ("processes", "memory_gib")  # they change only the order of sums
    field: AnyFieldSettings = Field(default=FastFieldSettings(), discriminator="kind")
    losses: LossSettings = LossSettings()
    steps: int = Field(default=0, ge=0)  # 0: chosen from the scene
    seconds: float | None = Field(default=None, gt=0)  # time limit for the field's steps; null: none
    novel_pose_steps: int = Field(default=100, ge=0)  # to tune the poses of novel frames against the finished field
    frames_per_step: int = Field(default=8, ge=1)  # frames whose rays make up one step
    rays_per_frame: int = Field(default=192, ge=1)  # at frames_per_step frames; fewer frames share all rays
    pose_learning_rate: float = Field(default=5e-4, ge=0)  # 0: keep the fitted poses and shape
    one_posture: bool | None = None  # one posture in all training frames; null: chosen from the scene
    ground: bool | None = None  # the ground is at height 0; null: chosen from the fitted feet
    absorb_steps: int = Field(default=100, ge=1)  # between exact updates of the posed bodies
    noise: float = Field(default=0.1, ge=0)  # std of the noise added to theta, T and v
    checkpoint_steps: int = Field(default=100, ge=1)  # between checkpoints
    snapshots_s: tuple[PositiveFloat, ...] = ()  # times at which to save the subject, below `snapshots/`
    processes: int = Field(default=0, ge=0)  # 0: one per GPU, or one without a GPU
    memory_gib: float | None = Field(default=None, gt=0)  # per process, for the rays of a step; null: what is free
    seed: Seed = 0  # of everything random

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

    excluded_from_key: ClassVar[tuple[str, ...]] = ("holdout",)  # the flow uses it and passes the camera to the stage
    max_meshes: int = Field(default=4, ge=1)  # per split
    max_images: int | None = Field(default=None, ge=1)  # per split; null: all
    report_rows: int = Field(default=3, ge=1)  # frames shown per split
    holdout: str | None = None  # a camera, or "each" in turn: train without it, score on it


class AssetSettings(Section):
    """Settings of the exported assets."""

    grid_cells: int = Field(default=256, ge=16, le=1024)  # of marching cubes, along the longest side
    topology: Literal["auto", "registered", "captured", "both"] = "auto"  # of the mesh: see docs/asset.md, Both meshes
    faces: int = Field(default=20_000, ge=100)  # of the captured mesh; the registered mesh has the body model's
    level_faces: tuple[PositiveInt, ...] = (10_000, 5_000)  # maximum number of triangles of each lower level
    texture_px: int | None = Field(default=None, ge=16, le=8192)  # side of the texture; null: see docs/asset.md
    texture_poses: int = Field(default=3, ge=1)  # poses whose median gives the field's colour of a texel
    photograph_frames: int = Field(default=16, ge=0)  # maximum number of frames for the texture; 0: the field alone
    normal_map_px: int = Field(default=0, ge=0, le=8192)  # side of the normal map; 0: none, since it shows grid cells
    correctives: int = Field(default=16, ge=0, le=64)  # blend shapes for what skinning leaves out; 0: none
    bones: Literal["along", "identity"] = "along"  # joint axes at rest: Y along the bone, or the stage's
    joint_names: Literal["own", "ue5", "mixamo", "humanik", "vrm", "smplx"] = "own"  # whose names joints have in files
    splats: int = Field(default=0, ge=0, le=1_000_000)  # number of Gaussian splats; 0: no splat files
    allow_poor: bool = False  # accept an asset that is more than 4 dB below its field
    version: str = "1"  # version in the asset's assetInfo
    licence: str = ""  # licence in the asset's assetInfo


class LimitSettings(Section):
    """Limits: how long a stage may make no progress before it is ended, and how much memory a recording's files may
    need while they are read. No result depends on them."""

    stage_s: float = Field(default=1800.0, gt=0, le=1e8)  # a stage without progress is ended after this, plus image_s
    image_s: float = Field(default=5.0, ge=0, le=1e4)  # added to stage_s for each image (frames times cameras)
    reader_gib: float = Field(default=8.0, ge=1, le=1e6)  # of memory for the process that reads a recording's files


class Settings(Section):
    """All settings of a run: one section per stage, on which alone its cache key depends, and the limits."""

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
    path = named_file(preset, CONFIGS, "preset")
    return overridden(validated(Settings, preset_tree(path), path), overrides)


def require_named_files(settings: Settings) -> None:
    """Raise InputError if a file that a setting names is not there: its stage would find that out only after those
    before it."""
    for section, values in settings:
        for name, value in values:
            if isinstance(value, Path) and not value.is_file():
                raise InputError(f"{section}.{name}: {value}: no such file; correct the path, or leave it out")


def preset_tree(path: Path, derived: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Return the tree of a preset's file, merged over that of the preset that it is `based_on`, if any: a name, or a
    path in the same folder or the working directory. derived: the presets that are based on this one. Raises InputError
    if it is among them, or holds no keys."""
    if path.resolve() in derived:
        raise InputError(f"{path}: is based on itself; correct based_on in it")
    tree = read_yaml(path)
    if not tree:
        raise InputError(f"{path}: holds no settings; write some, or a line like `based_on: fast`")
    base = tree.pop("based_on", None)
    if base is None:
        return tree
    try:
        below = named_file(str(base), CONFIGS, "preset", path.parent)
    except InputError as error:
        raise InputError(f"{path}: based_on: {error}") from None
    return _merged(preset_tree(below, (*derived, path.resolve())), tree)


def overridden(settings: S, overrides: Sequence[str]) -> S:
    """Return settings with overrides like "training.steps=100"; raises InputError, one line, for a key or value that is
    not allowed."""
    tree = settings.model_dump()
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals:
            raise InputError(f"--set {override}: write it as section.name=value")
        parts = key.split(".")
        if len(parts) > MAX_DEPTH:
            raise InputError(f"--set {key}: no such key; `hnerf settings` lists them")
        change: Any = value.strip()
        literal = change[:1] not in ("'", '"') and change not in NULLS
        if not (literal and _is_text(settings, parts)):  # in text, "1.10" and "by A: b # 3" are kept as they are
            change = parse_yaml(value, f"--set {override}")
        for part in reversed(parts):
            change = {part: change}
        tree = _merged(tree, change)
    message = " ".join(f"--set {override}" for override in overrides)
    return validated(type(settings), tree, message) if overrides else settings


def _is_text(settings: BaseModel, key: Sequence[str]) -> bool:
    """Return whether the setting with this key, section by section, takes any text or path."""
    section: object = settings
    for part in key[:-1]:
        section = dict(section).get(part) if isinstance(section, BaseModel) else None
    field = type(section).model_fields.get(key[-1]) if isinstance(section, BaseModel) else None
    return field is not None and not {str, Path}.isdisjoint({field.annotation, *get_args(field.annotation)})


def with_changes(settings: Settings, path: Path) -> Settings:
    """Return settings with those values replaced that a YAML file gives, such as one of `configs/ablations/`.

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


def named_file(name: str, folder: Path, what: str, beside: Path = Path()) -> Path:
    """Return the path of the YAML file of this name in a folder, or else `name` itself as a path, in the folder
    `beside` or the working directory. what: a word for it. Raises InputError, which lists the files of the folder, if
    there is none."""
    with suppress(OSError, ValueError):  # of a name that is too long, or holds a NUL
        for path in (folder / f"{name}.yaml", beside / name, Path(name)):
            if path.is_file():
                return path
    known = ", ".join(sorted(p.stem for p in folder.glob("*.yaml")))
    raise InputError(f"{name[:80]}: no such {what} or file; there are {known}")


def title_of(name: str) -> str:
    """Return the title, for file names, of what `named_file` finds: the name, which may have dots, or the file's."""
    return re.sub(r"\.ya?ml$", "", Path(name).name)


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the keys and values of a YAML file, an empty dictionary for an empty file. Raises InputError, one line, if
    it holds anything else, or more than settings need."""
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
            with suppress(LookupError, TypeError):  # the location also names kinds of a union, which are no keys
                node = node[part]
                key.append(str(part))
        key += [str(part) for part in first["loc"][-1:] if first["type"] == "missing"]
        wrong, advice = first["msg"].removeprefix("Value error, "), "correct it"
        if first["type"] == "missing":
            wrong, advice = "is missing", "add it"
        if first["type"] == "tuple_type":
            wrong, advice = "is not a list", "write it like [8,16]"
        if first["type"] in ("model_type", "model_attributes_type"):
            wrong, advice = "is a section", "give its keys, each with a value"
        if first["type"] == "union_tag_not_found":
            wrong, advice = f"{first['ctx']['discriminator']} is missing", "add it"
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

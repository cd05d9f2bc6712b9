"""The JSON that stages write: every key with its type and unit; other keys are refused when a file is written.

`python -m hnerf.results FOLDER` writes a JSON schema of each file, as in docs/schemas/.
"""

import argparse
import json
from pathlib import Path
from typing import Any, Literal, NotRequired

from pydantic import ConfigDict, TypeAdapter, with_config
from typing_extensions import TypedDict

Split = Literal["novel_view", "novel_pose", "novel_pose_posed", "novel_pose_tracked"]
Mean = Literal["psnr", "ssim", "mask_iou", "lpips", "empty_psnr", "one_colour_psnr"]
Primary = Literal["novel_view", "novel_pose"]  # splits that are meshed, and that held-out cameras are scored on


class FitReport(TypedDict):
    """report.json of the body fit; lists over frames. seconds: of each part, and in no file.

    silhouette_iou: with the masks, null without any; beta: shape values by name; keypoint_offsets_m (25, 3): between
    where the detector and the body model place a keypoint; given_poses: how poses that came with the recording were
    used; on_ground: with one camera, whether world height 0 counted as the ground.
    """

    seconds: NotRequired[dict[str, float]]
    frames: list[int]
    keypoint_residual_px: list[float | None]
    silhouette_iou: list[float | None] | None
    poor_frames: list[int]
    stature_m: float
    beta: dict[str, float]
    keypoint_offsets_m: list[list[float]]
    given_poses: NotRequired[str]
    on_ground: NotRequired[bool]


class ChosenSetting(TypedDict):
    """A setting that was chosen from the scene, and why."""

    setting: str
    value: Any
    reason: str


class TrainingReport(TypedDict):
    """report.json of training. seconds: of the steps of both phases, field_seconds: of the field's own; setup_seconds:
    of what comes before them, and in neither; the mean changes are those of all poses since the fit."""

    device: str
    processes: int
    setup_seconds: float
    seconds: float
    field_seconds: float
    steps: int
    peak_memory_gib: float
    parameters: int
    model_mib: float
    mean_turn_deg: float
    mean_move_mm: float
    decisions: list[ChosenSetting]


class ImageScores(TypedDict):
    """Scores of one image against the truth (docs/method.md, "Evaluation protocol"), in dB or from 0 to 1. lpips: null
    without its weights. The distances from training are in scores.json alone."""

    camera: str
    frame: int
    psnr: float
    ssim: float
    mask_iou: float
    lpips: float | None
    empty_psnr: float
    one_colour_psnr: float
    view_angle_deg: NotRequired[float]
    pose_distance_deg: NotRequired[float]


class SurfaceScores(TypedDict):
    """Scores of one surface against the true one. chamfer_l2_e3: mean squared distance of both directions, m^2 x 1e3;
    chamfer_mm: mean distance; normal_consistency: mean |cos| of the normals at nearest points; iou of the volumes;
    watertight: whether the prediction is closed."""

    frame: int
    chamfer_l2_e3: float
    chamfer_mm: float
    normal_consistency: float
    iou: float
    watertight: bool
    pose_distance_deg: NotRequired[float]


class GeometryScores(TypedDict):
    """Means over n surfaces. watertight: the share of closed ones."""

    chamfer_l2_e3: float
    chamfer_mm: float
    normal_consistency: float
    iou: float
    watertight: float
    n: int
    per_surface: list[SurfaceScores]


class SplitMeans(TypedDict):
    """Means over the n images of a split, null where there are none, for a reason. reference: what was compared with;
    without_mask, without_person: images that were left out; geometry: of splits that are meshed."""

    n: int
    psnr: float | None
    ssim: float | None
    mask_iou: float | None
    lpips: float | None
    empty_psnr: float | None
    one_colour_psnr: float | None
    without_mask: NotRequired[int]
    without_person: NotRequired[int]
    reference: NotRequired[str]
    reason: NotRequired[str]
    geometry: NotRequired[GeometryScores | None]
    geometry_reason: NotRequired[str]


class SplitScores(SplitMeans):
    """Scores of a split and of its images."""

    per_image: list[ImageScores]


class HeldOutCamera(TypedDict):
    """Scores of a camera that was left out of fit and training; camera: only in holdout.json, which has it alone."""

    camera: NotRequired[str]
    trained_on: list[str]
    novel_view: SplitScores
    novel_pose: SplitScores


class HeldOut(TypedDict):
    """Scores by camera left out, and by split their means over cameras."""

    what: str
    cameras: dict[str, HeldOutCamera]
    mean: dict[Primary, dict[Mean, float | None]]


class Metrics(TypedDict):
    """metrics.json of evaluation. lpips: the network's weights, or why there are none; seconds: by part."""

    protocol: str
    lpips: str
    seconds_per_image: float
    novel_view: SplitScores
    novel_pose: SplitScores
    novel_pose_posed: SplitScores
    novel_pose_tracked: SplitScores
    holdout: HeldOut | None
    holdout_reason: NotRequired[str]
    seconds: dict[str, float]


class Machine(TypedDict):
    """The machine that measurements were taken on. threads: that torch uses; gpu: null without one."""

    cpu: str
    cores: int
    threads: int
    gpu: str | None
    torch: str
    python: str


class CurvePoint(SplitMeans):
    """Scores after some seconds of training."""

    seconds: float


class Picture(TypedDict):
    """A scored image of which there is a picture."""

    camera: str
    frame: int


class EndScores(TypedDict):
    """scores.json of a training of which only the end is scored. training: its report.json, which was
    checked when it was written."""

    training: dict[str, Any]
    curve: list[CurvePoint]


class Scores(EndScores):
    """scores.json of a benchmark's training. split: of the curve and the pictures; frame_seconds: of rendering, by the
    image's longest side in pixels."""

    machine: Machine
    protocol: str
    lpips: str
    split: Split
    novel_view: SplitScores
    novel_pose: SplitScores
    novel_pose_posed: SplitScores
    novel_pose_tracked: SplitScores
    pictures: list[Picture]
    frame_seconds: dict[str, float]


FILES: dict[str, Any] = {
    "fit-report": FitReport,
    "training-report": TrainingReport,
    "metrics": Metrics,
    "holdout": HeldOutCamera,
    "scores": Scores,
}


def _closed(kind: Any) -> TypeAdapter[Any]:
    """Return a validator of a kind of result that allows no other keys, in it or in its parts."""
    return TypeAdapter(with_config(ConfigDict(extra="forbid"))(kind))


def write_result(path: Path, kind: Any, result: Any) -> None:
    """Write a result as JSON. Raises ValidationError if it has a key that its kind lacks, or a value of another
    type."""
    _closed(kind).validate_python(result)
    path.write_text(json.dumps(result, indent=1))


def write_schemas(folder: Path) -> None:
    """Write `<name>.json`, the JSON schema of each kind of result, into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, kind in FILES.items():
        (folder / f"{name}.json").write_text(json.dumps(_closed(kind).json_schema(), indent=1) + "\n")


def main(argv: list[str] | None = None) -> None:
    """Write the schemas into the folder that the command line names."""
    parser = argparse.ArgumentParser(prog="python -m hnerf.results", description="Write a JSON schema of each result.")
    parser.add_argument("folder", type=Path, help="where to, like docs/schemas")
    write_schemas(parser.parse_args(argv).folder)


if __name__ == "__main__":
    main()

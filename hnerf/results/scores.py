"""Scores: `metrics.json` and `holdout.json` of evaluation, `scores.json` of benchmarks."""

from typing import Any, Literal, NotRequired

from typing_extensions import TypedDict

Split = Literal["novel_view", "novel_pose", "novel_pose_posed", "novel_pose_tracked"]
Mean = Literal["psnr", "ssim", "mask_iou", "lpips", "empty_psnr", "one_colour_psnr"]
Primary = Literal["novel_view", "novel_pose"]  # these splits are meshed and score held-out cameras


class ImageScores(TypedDict):
    """Scores of one image against the truth (docs/method.md, "Evaluation protocol"), in dB or from 0 to 1. lpips: null
    if its weights are missing. view_angle_deg, pose_distance_deg: distances from the training data, only in
    scores.json."""

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
    """Scores of one surface against the true one. chamfer_l2_e3: mean squared distance over both directions, m^2 x 1e3;
    chamfer_mm: mean distance; normal_consistency: mean |cos| between normals at nearest points; iou: of the volumes;
    watertight: whether the predicted surface is closed."""

    frame: int
    chamfer_l2_e3: float
    chamfer_mm: float
    normal_consistency: float
    iou: float
    watertight: bool
    pose_distance_deg: NotRequired[float]


class GeometryScores(TypedDict):
    """Means over n surfaces. watertight: fraction of closed surfaces."""

    chamfer_l2_e3: float
    chamfer_mm: float
    normal_consistency: float
    iou: float
    watertight: float
    n: int
    per_surface: list[SurfaceScores]


class SplitMeans(TypedDict):
    """Means over the n images of a split; null if there are none, and `reason` says why. reference: what the renderings
    were compared with. without_mask, without_person: number of images left out for lack of a mask, or of the person.
    geometry: only for splits that are meshed."""

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
    """Mean scores of a split and the scores of each image."""

    per_image: list[ImageScores]


class HeldOutCamera(TypedDict):
    """Scores of a camera that was left out of the fit and of training. camera: its name, only in holdout.json, which
    scores a single camera."""

    camera: NotRequired[str]
    trained_on: list[str]
    novel_view: SplitScores
    novel_pose: SplitScores


class HeldOut(TypedDict):
    """Scores of each held-out camera, and their mean over cameras for each split."""

    what: str
    cameras: dict[str, HeldOutCamera]
    mean: dict[Primary, dict[Mean, float | None]]


class Metrics(TypedDict):
    """metrics.json of evaluation. lpips: which network weights were used, or why there are none. seconds: duration of
    each part."""

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
    """The machine that measurements were taken on. threads: number of threads that torch uses; gpu: null without a
    GPU."""

    cpu: str
    cores: int
    threads: int
    gpu: str | None
    torch: str
    python: str


class CurvePoint(SplitMeans):
    """Scores after a number of seconds of training."""

    seconds: float


class Picture(TypedDict):
    """A scored image whose rendering is kept as a picture."""

    camera: str
    frame: int


class EndScores(TypedDict):
    """scores.json of a training run that is scored only at its end. training: its report.json, which was checked when
    it was written."""

    training: dict[str, Any]
    curve: list[CurvePoint]


class Scores(EndScores):
    """scores.json of a benchmark's training run. split: the split of the curve and the pictures. frame_seconds:
    rendering time of one frame, by the image's longest side in pixels."""

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

"""The reports of the stages before training."""

from typing import Any, Literal, NotRequired

from typing_extensions import TypedDict


class CameraUncertainty(TypedDict):
    """Standard errors of a camera: of its direction, its position, and its focal length as a share."""

    turn_deg: float
    move_m: float
    focal: float


class CameraFromPerson(TypedDict):
    """A camera found from the person. median_px, p95_px: residuals of keypoints, in pixels of the ingested images;
    focal_px, k1: as recorded; intrinsics: where they come from, in words."""

    median_px: float
    p95_px: float
    focal_px: float
    k1: float
    intrinsics: str
    uncertainty: CameraUncertainty


class CamerasReport(TypedDict):
    """report.json of the stage `cameras` and of `hnerf calibrate --from person`. height_m: the person's, to which the
    cameras were scaled; scale_sd: standard error of the scale, as a share; up_sd_deg: of the vertical axis; cost_px:
    trimmed mean residual; held_out_px: cost of each kind of lens that was tried, on held-out frames and joints."""

    height_m: float
    scale_sd: float
    up_sd_deg: float
    notes: list[str]
    cost_px: float
    held_out_px: dict[str, float]
    cameras: dict[str, CameraFromPerson]


class DetectedCamera(TypedDict):
    """What was detected in one camera: the number of images, of those with anybody, and of people in one image."""

    images: int
    seen: int
    people: int


class DetectedPerson(TypedDict):
    """A person that was detected. person: "subject"; of people left out, "left 1", "left 2" and so on (no side is
    meant); height_px: median; claim: to be the subject, relative to whoever has most."""

    person: str
    cameras: int
    images: int
    height_px: float
    moves: bool
    claim: float


class DetectionReport(TypedDict):
    """detection.json of the stage `detection`; the subject comes first."""

    cameras: dict[str, DetectedCamera]
    people: list[DetectedPerson]


class MeasuredOffset(TypedDict):
    """When a camera exposed relative to the others. reason: why that cannot be observed, else empty."""

    observable: bool
    frames: float | None
    standard_error_frames: float | None
    reason: str


class CheckedCamera(TypedDict):
    """The verdict on one camera. Residuals of keypoints as used and as given; null if none were measured. frame_offset:
    the one that is corrected; timing: as measured; reasons: in words."""

    status: Literal["ok", "refined", "suspect", "rejected"]
    median_px: float | None
    p95_px: float | None
    median_before_px: float | None
    p95_before_px: float | None
    frame_offset: float
    timing: MeasuredOffset
    reasons: list[str]


class BeforeAndAfter(TypedDict):
    """Cost of the cameras as given, and as used; null if it was not measured."""

    before: float | None
    after: float | None


class WithoutEachCamera(TypedDict):
    """Cost of the other cameras if each is left out in turn, as given and as used; null if it was not measured."""

    before: dict[str, float | None] | None
    after: dict[str, float | None] | None


class KeypointEvidence(TypedDict):
    """Residuals of one camera's keypoints. cost_of_the_others_px: cost without this camera."""

    median_px: float | None
    p95_px: float | None
    cost_of_the_others_px: float | None


class OutlineEvidence(TypedDict):
    """Distances of a person's outline from where the other cameras allow it, over a number of rays."""

    rays: int
    mean_px: NotRequired[float]
    median_px: NotRequired[float]
    p95_px: NotRequired[float]


class MatchEvidence(TypedDict):
    """Distances of matched image points from their epipolar lines. reason: why there are none."""

    count: int
    median_px: NotRequired[float]
    reason: NotRequired[str]


class CameraEvidence(TypedDict):
    """Evidence about all cameras, each kind by camera; matches also by pair. Text says why a kind is missing."""

    keypoints: dict[str, KeypointEvidence]
    silhouettes: dict[str, OutlineEvidence] | str
    matches: dict[str, MatchEvidence]
    match_pairs: dict[str, MatchEvidence] | str


class Witnesses(TypedDict, total=False):
    """Evidence about the cameras as given and as used, and what footage of a board says; empty without keypoints."""

    as_given: CameraEvidence
    as_used: CameraEvidence
    board_footage: dict[str, Any] | str


class CalibrationCheck(TypedDict):
    """report.json of the stage `calibration`. verdict: the most severe status; doubts: what in the recording
    contradicts the calibration; unjudged_cameras: those for testing; costs: trimmed mean residuals;
    held_out_cost_px, outlines_cost_px: of each correction that was tried, on held-out frames and by outlines."""

    verdict: Literal["ok", "refined", "suspect", "rejected"]
    doubts: list[str]
    cameras: dict[str, CheckedCamera]
    unjudged_cameras: list[str]
    body_height_m: float | None
    trimmed_cost_px: BeforeAndAfter
    trimmed_cost_without_px: WithoutEachCamera
    held_out_cost_px: dict[str, float | None]
    outlines_cost_px: dict[str, float | None]
    notes: list[str]
    witnesses: Witnesses


class DroppedMask(TypedDict):
    """A mask that is not used, and why."""

    frame: int
    reason: str


class MaskNote(TypedDict):
    """A remark on a mask that is used."""

    frame: int
    note: str


class SegmentedCamera(TypedDict):
    """The masks of one camera. backend: what they come from."""

    backend: str
    median_area_px: int
    dropped: list[DroppedMask]
    notes: list[MaskNote]


class SegmentationReport(TypedDict, total=False):
    """report.json of the stage `segmentation`. moved_px: how far outlines moved in each round of fit and masks."""

    cameras: dict[str, SegmentedCamera]
    moved_px: list[float]


class FitReport(TypedDict):
    """report.json of the body fit, before its face was moved; lists have one value per frame. seconds: duration of each
    part, not written to the file. silhouette_iou: IoU of the body's silhouette with the masks, null without masks.
    beta: shape values by name. keypoint_offsets_m (25, 3): offset between where the detector and the body model place
    each keypoint. given_poses: how poses that came with the recording were used. on_ground: with one camera, whether
    world height 0 was taken as the ground; doubts: what that camera does not determine."""

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
    doubts: NotRequired[list[str]]

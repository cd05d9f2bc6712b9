"""The Pose2Sim layout: calibration/Calib*.toml, videos/<camera>.mp4, pose/<camera>_json/*.json."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from hnerf.capture.footage import Footage, Video
from hnerf.capture.guarded import files_in, inside, read_toml
from hnerf.capture.lens import Lens, checked_lens
from hnerf.errors import CaptureError

# Rows of BODY_25B that make BODY_25 (OpenPose, src/openpose/pose/poseParameters.cpp); pairs are averaged. BODY_25B's
# own neck (17) is the upper neck; BODY_25's is the middle of the shoulders, and its mid-hip that of the hips.
BODY_25_FROM_25B = (
    (0,), (5, 6), (6,), (8,), (10,), (5,), (7,), (9,), (11, 12), (12,), (14,), (16,), (11,), (13,), (15,),
    (2,), (1,), (4,), (3,), (19,), (20,), (21,), (22,), (23,), (24,),
)  # fmt: skip


@dataclass(frozen=True)
class Pose2Sim:
    """A folder as Pose2Sim's own tools read it: world to camera, metres, Z up."""

    folder: Path
    novel_pose_share: ClassVar[float] = 0.2  # the last fifth: a motion that the training frames do not contain

    @staticmethod
    def recognises(folder: Path) -> bool:
        """Whether the folder looks like this layout."""
        return (folder / "calibration").exists()

    def lenses(self) -> dict[str, Lens]:
        """Every camera of the one calibration file."""
        files = [p for p in files_in(self.folder, "calibration") if p.match("Calib*.toml")]
        if len(files) != 1:
            raise CaptureError(f"{self.folder / 'calibration'}: {len(files)} files Calib*.toml; leave exactly one")
        tables = {key: table for key, table in read_toml(files[0]).items() if key != "metadata"}
        if not tables:
            raise CaptureError(f"{files[0]}: calibrates no camera; calibrate again")
        lenses = (_lens(files[0], key, table) for key, table in tables.items())
        return {lens.name: lens for lens in lenses}

    def footage(self, camera: str) -> Footage:
        """videos/<camera>.mp4."""
        return Video.open(inside(self.folder, "videos", f"{camera}.mp4"))

    def keypoint_files(self, camera: str) -> dict[int, Path]:
        """pose/<camera>_json/*.json, one a video frame in the order of their names."""
        return dict(enumerate(p for p in files_in(self.folder, "pose", f"{camera}_json") if p.suffix == ".json"))

    def mask_files(self, camera: str) -> dict[int, Path]:
        """This layout has none."""
        return {}

    def plate_file(self, camera: str) -> Path | None:
        """This layout has none."""
        return None

    def to_body_25(self, keypoints: np.ndarray) -> np.ndarray:
        """BODY_25B to BODY_25; the files do not say which they hold, so the points themselves are asked."""
        return keypoints if is_body_25(keypoints) else body_25_from_25b(keypoints)


def body_25_from_25b(keypoints: np.ndarray) -> np.ndarray:
    """(..., 25, 3) BODY_25B to BODY_25. A mean of two points has the lower confidence, and is absent if either is."""
    parts = [keypoints[..., list(rows), :] for rows in BODY_25_FROM_25B]
    confidence = np.stack([part[..., 2].min(-1) for part in parts], -1)[..., None]
    xy = np.stack([part[..., :2].mean(-2) for part in parts], -2)
    return np.concatenate([xy, confidence], -1) * (confidence > 0)


def is_body_25(keypoints: np.ndarray) -> bool:
    """Whether (..., 25, 3) detections are in BODY_25's order rather than BODY_25B's.

    BODY_25's points 8, 9, 12 are mid-hip, right and left hip, so 8 lies midway; BODY_25B's are right elbow, left wrist,
    right hip. Judged by the median over all detections, against the distance from point 0 (nose in both) to the hips.
    """
    seen = keypoints[(keypoints[..., [0, 8, 9, 12], 2] > 0).all(-1)][..., :2]
    if len(seen) == 0:
        return False
    middle = (seen[:, 9] + seen[:, 12]) / 2
    offset = np.linalg.norm(seen[:, 8] - middle, axis=-1) / (np.linalg.norm(seen[:, 0] - middle, axis=-1) + 1e-9)
    return bool(np.median(offset) < 0.1)


def _lens(source: Path, key: str, table: Any) -> Lens:
    try:
        if table.get("fisheye", False):
            raise CaptureError(f"{source}: camera {key}: fisheye lenses are not read; undistort its video first")
        width_px, height_px = table["size"]
        return checked_lens(
            sources=(source, source),
            name=table["name"],
            K=np.array(table["matrix"], dtype=np.float64),
            distortion=np.array(table["distortions"], dtype=np.float64),
            R=np.array(table["rotation"], dtype=np.float64),
            t_m=np.array(table["translation"], dtype=np.float64),
            size_px=(float(width_px), float(height_px)),
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise CaptureError(f"{source}: camera {key}: {error} is missing or no number; calibrate again") from None

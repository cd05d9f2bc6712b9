"""The keypoint sets that detectors write, and their conversion to OpenPose's BODY_25, the only one used after
ingestion.

BODY_25's neck is the midpoint of the shoulders and its mid-hip that of the hips; both are computed this way for any set
that lacks them. The neck of BODY_25B and Halpe is the base of the skull and is not used.
"""

from typing import Literal, NamedTuple

import numpy as np

from hnerf.errors import InputError

# Points of the left hand, then of the right: the wrist, then four of each finger, from the thumb on. Every array of
# more points ends with them: the two whole-body sets, and others to whose points a file adds hands.
HAND_POINTS = 42

KeypointSetName = Literal[
    "coco_17", "coco_18", "body_25", "body_25b", "halpe_26", "coco_wholebody", "halpe_136", "blazepose_33"
]


class KeypointSet(NamedTuple):
    """One keypoint set. points: number per person; rows (25): for each BODY_25 keypoint, the points whose mean it is;
    none if the set lacks it."""

    points: int
    rows: tuple[tuple[int, ...], ...]


# All sets but OpenPose's older two begin with COCO's 17 (Lin et al. 2014: nose, then left and right eye, ear, shoulder,
# elbow, wrist, hip, knee, ankle). This gives BODY_25's nose to left ear in terms of those; the feet follow: left big
# toe, small toe, heel, then the right.
_COCO = (
    (0,), (5, 6), (6,), (8,), (10,), (5,), (7,), (9,), (11, 12), (12,), (14,), (16,), (11,), (13,), (15,),
    (2,), (1,), (4,), (3,),
)  # fmt: skip
# Bazarevsky et al. 2020: nose, eyes and ears, mouth, arms, hands, legs, heels (29, 30), toes (31, 32), left first.
_BLAZEPOSE = (
    (0,), (11, 12), (12,), (14,), (16,), (11,), (13,), (15,), (23, 24), (24,), (26,), (28,), (23,), (25,), (27,),
    (5,), (2,), (8,), (7,), (31,), (), (29,), (32,), (), (30,),
)  # fmt: skip
_NO_FEET = ((),) * 6
_HALPE = (*_COCO, (20,), (22,), (24,), (21,), (23,), (25,))  # Halpe-FullBody: toes and heels in pairs

SETS: dict[KeypointSetName, KeypointSet] = {
    "coco_17": KeypointSet(17, _COCO + _NO_FEET),
    # OpenPose's COCO model: nose, neck, arms, legs from the hips down, eyes, ears; the right side first.
    "coco_18": KeypointSet(18, (*((k,) for k in range(8)), (8, 11), *((k,) for k in range(8, 18)), *_NO_FEET)),
    "body_25": KeypointSet(25, tuple((k,) for k in range(25))),
    # OpenPose, src/openpose/pose/poseParameters.cpp: 17 upper neck, 18 head top, then the feet.
    "body_25b": KeypointSet(25, (*_COCO, *((k,) for k in range(19, 25)))),
    "halpe_26": KeypointSet(26, _HALPE),
    "coco_wholebody": KeypointSet(133, (*_COCO, *((k,) for k in range(17, 23)))),  # Jin et al. 2020; face unused
    "halpe_136": KeypointSet(136, _HALPE),  # Halpe-26, then face and hands
    "blazepose_33": KeypointSet(33, _BLAZEPOSE),
}
KNOWN = ", ".join(f"{name} ({known.points})" for name, known in SETS.items())
COUNTS = {known.points for known in SETS.values()}


def to_body_25(detections: dict[str, np.ndarray], named: KeypointSetName | None) -> dict[str, np.ndarray]:
    """Convert detections (frames, people, K, 3) x_px, y_px, confidence by camera to BODY_25 keypoints (frames, people,
    25, 3).

    `named` is the set of all cameras. Without it, the number of points identifies the set; for 25, which two sets have,
    so does which points form the face. K is 0 if nobody was detected. Hands do not count. Raises InputError if `named`
    has another number of points.
    """
    detections = {camera: _without_added_hands(points) for camera, points in detections.items()}
    of_25 = [points.reshape(-1, 25, 3) for points in detections.values() if points.shape[-2] == 25]
    set_of_25: KeypointSetName = "body_25" if not of_25 or is_body_25(np.concatenate(of_25)) else "body_25b"
    by_count = {known.points: known for known in SETS.values()} | {25: SETS[set_of_25]}
    found = {}
    for camera, points in detections.items():
        count = points.shape[-2]
        if count == 0:
            found[camera] = np.zeros((*points.shape[:-2], 25, 3))
            continue
        chosen = SETS[named] if named else by_count[count]
        if chosen.points != count:
            raise InputError(
                f'capture.toml: keypoints = "{named}" has {chosen.points} points, but camera {camera} has {count}; '
                "correct it"
            )
        found[camera] = _combined(points, chosen)
    return found


def hands_of(detections: np.ndarray) -> np.ndarray | None:
    """Return the left and the right hand (..., 2, 21, 3) of detections (..., K, 3); None if none is seen."""
    if detections.shape[-2] <= HAND_POINTS or not (detections[..., -HAND_POINTS:, 2] > 0).any():
        return None
    return detections[..., -HAND_POINTS:, :].reshape(*detections.shape[:-2], 2, HAND_POINTS // 2, 3)


def _without_added_hands(points: np.ndarray) -> np.ndarray:
    """Return the points of one of SETS: points (..., K, 3) without hands, if these are not in the set itself."""
    return points[..., :-HAND_POINTS, :] if points.shape[-2] - HAND_POINTS in COUNTS else points


def _combined(points: np.ndarray, known: KeypointSet) -> np.ndarray:
    """Return BODY_25 keypoints (..., 25, 3) from points (..., K, 3). A mean of two points has the lower confidence, and
    is absent if either is."""
    combined = np.zeros((*points.shape[:-2], 25, 3))
    for k, rows in enumerate(known.rows):
        if rows:
            part = points[..., rows, :]
            combined[..., k, :2], combined[..., k, 2] = part[..., :2].mean(-2), part[..., 2].min(-1)
    return combined * (combined[..., 2:] > 0)


def is_body_25(keypoints: np.ndarray) -> bool:
    """Return whether (..., 25, 3) detections are in BODY_25's order rather than BODY_25B's; True if undecided.

    BODY_25's points 1 to 4 are neck and right arm, and 15 to 18 are eyes and ears; BODY_25B's points 1 to 4 are eyes
    and ears, and among 15 to 18 are the ankles. From every side, a face is smaller than the extent of the other points,
    whatever a detector's error. The majority of detections decides.
    """
    people = keypoints.reshape(-1, 25, 3)
    first_px, last_px = _extent_px(people[:, 1:5]), _extent_px(people[:, 15:19])
    return int((first_px < last_px).sum()) <= int((last_px < first_px).sum())


def _extent_px(points: np.ndarray) -> np.ndarray:
    """Return the diagonal of the box around the visible points of each of (n, K, 3); NaN if fewer than two are
    visible."""
    seen = points[..., 2:] > 0
    low, high = (np.where(seen, points[..., :2], far) for far in (np.inf, -np.inf))
    extent_px = np.linalg.norm(high.max(1) - low.min(1), axis=-1)
    return np.where(seen.sum((1, 2)) >= 2, extent_px, np.nan)

"""Files that keypoint detectors write: OpenPose's, one per frame, and lists of COCO results, one per camera."""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from hnerf.capture.keypoint_sets import COUNTS, HAND_POINTS, KNOWN
from hnerf.capture.safe_io import MAX_TEXT_BYTES, read_json
from hnerf.errors import InputError

MAX_PEOPLE = 64  # in one image
FRAME_BYTES = 32_000  # in a list of results: four people of 136 points with all digits
OPENPOSE_HANDS = ("hand_left_keypoints_2d", "hand_right_keypoints_2d")
MAX_PX = 1e6  # of a coordinate; far larger ones overflow in later arithmetic


def read_openpose(path: Path) -> np.ndarray:
    """Read an OpenPose file: (people, K, 3) x_px, y_px, confidence in the file's order. K is a known number of points,
    HAND_POINTS more if the file has hands, or 0 without people; people without points are ignored. Raises InputError if
    it is no such file."""
    try:
        people = _check_count(path, read_json(path)["people"])
        found = [person for person in people if person != {} and person["pose_keypoints_2d"] != []]
        hands = [[person.get(side, []) for side in OPENPOSE_HANDS] for person in found]
        return _with_hands(path, _people(path, [person["pose_keypoints_2d"] for person in found]), hands)
    except (KeyError, TypeError):
        raise InputError(f"{path}: no list of people with pose_keypoints_2d; detect them again") from None


def write_openpose(path: Path, keypoints: np.ndarray) -> None:
    """Write one person's keypoints (K, 3) x_px, y_px, confidence as OpenPose does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    person = {"person_id": [-1], "pose_keypoints_2d": keypoints.ravel().tolist()}
    path.write_text(json.dumps({"version": 1.3, "people": [person]}))


def read_results(path: Path, frames: Iterable[int]) -> list[np.ndarray]:
    """Read a list of {image_id, keypoints, score}, as AlphaPose writes for a whole recording, or what MMPose writes for
    a video; return people for each of the frames as `read_openpose` does.

    image_id: the frame's number, or an image name that ends in it. Frames that are not listed show nobody. Raises
    InputError if it is no such file, or lists other frames.
    """
    frames = tuple(frames)
    try:
        people: dict[int, list[Any]] = {}
        results = _as_coco(read_json(path, MAX_TEXT_BYTES + FRAME_BYTES * len(frames)))
        if len(results) > MAX_PEOPLE * len(frames):
            raise InputError(
                f"{path}: {len(results)} people in {len(frames)} images; keep at most {MAX_PEOPLE} in each"
            )
        for result in results:
            people.setdefault(_frame(result["image_id"]), []).append(result["keypoints"])
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{path}: no list of image_id and keypoints; write COCO results again") from None
    if strange := sorted(set(people).difference(frames)):
        raise InputError(
            f"{path}: image_id {strange[0]} is none of the recording's frames {frames[0]} to {frames[-1]}; "
            "number them as the pictures are, videos from 0"
        )
    return [_people(path, _check_count(path, people.get(frame, []))) for frame in frames]


def _as_coco(found: Any) -> Any:
    """Return MMPose's predictions for a video as COCO results, anything else as it is. MMPose's demos count frames from
    1, its inferencer from 0. Raises KeyError, TypeError or ValueError if a value is missing or wrong."""
    frames, first = (found["instance_info"], 1) if isinstance(found, dict) else (found, 0)
    if not frames or "instances" not in frames[0]:
        return frames
    return [
        {
            "image_id": frame["frame_id"] - first,
            "keypoints": [[*at, sure] for at, sure in zip(one["keypoints"], one["keypoint_scores"], strict=True)],
        }
        for frame in frames
        for one in frame["instances"]
    ]


def _frame(image_id: object) -> int:
    """Return the frame number that an image_id is or ends in: 12, "12.jpg" and "walk_000012.png" are frame 12. Raises
    ValueError if there is none."""
    if type(image_id) is int and image_id >= 0:
        return image_id
    found = re.search(r"(?<![0-9])0*([0-9]{1,9})(\.\w+)?$", image_id) if isinstance(image_id, str) else None
    if not found:
        raise ValueError(image_id)
    return int(found[1])


def _check_count(path: Path, people: list[Any]) -> list[Any]:
    """Return the people of one image. Raises InputError if there are too many."""
    if len(people) > MAX_PEOPLE:
        raise InputError(f"{path}: {len(people)} people in an image; keep at most {MAX_PEOPLE}")
    return people


def _people(path: Path, triples: list[Any]) -> np.ndarray:
    """Convert flat x, y, confidence lists of one image to an array. Raises InputError if they are not keypoints."""
    if not triples:
        return np.zeros((0, 0, 3))
    points = _points(path, triples)
    if points.shape[1] not in COUNTS:
        raise InputError(f"{path}: {points.shape[1]} keypoints a person; known sets are {KNOWN}")
    return points


def _with_hands(path: Path, people: np.ndarray, hands: list[list[Any]]) -> np.ndarray:
    """Return people (P, K, 3) with the points of their left and right hands, flat lists that are empty for an absent
    hand, appended; without them if no list has any. Raises InputError if they are not 21 points each."""
    if not any(side != [] for sides in hands for side in sides):
        return people
    absent = [0.0] * (3 * HAND_POINTS // 2)
    points = _points(path, [[absent if side == [] else side for side in sides] for sides in hands])
    if points.shape[1] != HAND_POINTS:
        raise InputError(f"{path}: a hand has {HAND_POINTS // 2} points; detect again, or without hands")
    return np.concatenate([people, points], 1)


def pad_hands(people: list[np.ndarray]) -> list[np.ndarray]:
    """Return the people of each image, (P, K, 3), with absent hands where only other images have hands."""
    most = max((found.shape[1] for found in people if len(found)), default=0)
    absent = ((0, 0), (0, HAND_POINTS), (0, 0))
    return [np.pad(p, absent) if len(p) and p.shape[1] == most - HAND_POINTS else p for p in people]


def _points(path: Path, triples: list[Any]) -> np.ndarray:
    """Convert lists of x, y, confidence, one for each person, to an array (P, K, 3). Raises InputError if they are not
    points."""
    try:
        points = np.array(triples, dtype=np.float64).reshape(len(triples), -1, 3)
    except (OverflowError, TypeError, ValueError):
        raise InputError(
            f"{path}: keypoints are not triples of numbers, the same number per person; detect again"
        ) from None
    if not np.isfinite(points).all():
        raise InputError(f"{path}: a keypoint is NaN or infinite; detect them again")
    points[..., 2] = points[..., 2].clip(0, 1)  # some detectors exceed 1, and COCO's own annotations reach 2
    return without_far_points(path, points)


def without_far_points(path: Path, points: np.ndarray) -> np.ndarray:
    """Return keypoints (..., 3) with those beyond MAX_PX set to zero. Raises InputError if one of them was seen."""
    far = (np.abs(points[..., :2]) > MAX_PX).any(-1)
    if (points[far][:, 2] > 0).any():
        raise InputError(f"{path}: a keypoint is beyond {MAX_PX:g} px; detect them again")
    return np.where(far[..., None], 0.0, points)


def pad_people(people: list[np.ndarray]) -> np.ndarray:
    """Stack each frame's array of its people, (P, ...), as (frames, most people, ...); absent people are 0."""
    most = max(1, *(len(found) for found in people))
    rows = np.zeros((len(people), most, *people[0].shape[1:]), people[0].dtype)
    for row, found in zip(rows, people, strict=True):
        row[: len(found)] = found
    return rows

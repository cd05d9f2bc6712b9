"""Tracking of people through a recording: detections on which the cameras agree, from frame to frame."""

from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from hnerf.geometry.camera import Camera
from hnerf.geometry.triangulation import confidence_of, solve_points

AGREEMENT_REACH = 0.15  # of a person's height in the image: beyond it a keypoint does not support a hypothesis
UNSUPPORTED_WEIGHT = 0.1  # of a detection without support from other cameras: one of them may be badly calibrated
MIN_SUPPORT = 0.2  # agreement of others with a detection (0.8 for a good one) that is no chance hit of a few keypoints
USUALLY = 0.5  # if others support at least this share of a camera's images, its unsupported detections are mistakes
CANDIDATES = 8  # combinations of people kept in each frame
JUMP_COST = 4.0  # in best scores of one camera, of a move by the person's own height between frames
FREE_JUMPS = 2.0  # in median movements between frames: jumps up to this cost nothing
MAX_PAIRED = 12  # most prominent people of an image who are compared with those of other cameras
MAX_PEOPLE = 4  # followed: the subject, and those whom the report lists as left out
SAME_SHARE = 0.1  # of a person's height: mean keypoint distance up to which two detections are one person
MOST_MOVING = 90  # percentile of keypoints
STILL_SHARE = 0.05  # of a person's height: a picture of a person moves less (detector noise: a hundredth)


class PersonTrack(NamedTuple):
    """A person followed through a recording. keypoints (C, frames, 25, 3), 0 where not seen; claim, in [0, 1]: the mean
    over cameras and frames of size x confidence x centrality x agreement of the cameras; moves: whether any part of the
    person does, unlike a picture on a wall; exchanged: in how many images of each camera the subject's left and right
    were exchanged, empty if that was not checked."""

    keypoints: np.ndarray
    claim: float
    moves: bool
    exchanged: tuple[int, ...] = ()


def follow_in_each_camera(cameras: list[Camera], people: list[np.ndarray]) -> list[PersonTrack]:
    """Follow the most prominent person in each camera separately and return them as one person; replaces
    `follow_people` if the cameras' relative poses are unknown. Returns an empty list if nobody is seen."""
    alone = [follow_people([camera], [found]) for camera, found in zip(cameras, people, strict=True)]
    best = [max(tracks, key=lambda track: (track.moves, track.claim), default=None) for tracks in alone]
    if not any(best):
        return []
    keypoints = np.concatenate([
        np.zeros((1, len(found), *found.shape[2:])) if track is None else track.keypoints
        for track, found in zip(best, people, strict=True)
    ])  # fmt: skip
    claims = [track.claim if track else 0.0 for track in best]
    return [PersonTrack(keypoints, float(np.mean(claims)), moves(keypoints))]


def follow_people(cameras: list[Camera], people: list[np.ndarray]) -> list[PersonTrack]:
    """Follow the most prominent person through time, then the remaining ones, at most MAX_PEOPLE.

    people: per camera (frames, P, 25, 3), in any order. A person is followed (Viterbi) over combinations of one
    detection from each camera on which the cameras agree: two-view triangulation predicts where each camera must see
    the person.
    """
    left = [_most_prominent(camera, found) for camera, found in zip(cameras, people, strict=True)]
    tracks: list[PersonTrack] = []
    frames = len(left[0])
    while len(tracks) < MAX_PEOPLE and any((found[..., 2] > 0).any() for found in left):
        candidates = [_frame_candidates(cameras, [found[i] for found in left]) for i in range(frames)]
        choice, supported, claim = _most_probable_sequence(candidates, left)
        if claim <= 0:
            break
        seen = choice >= 0
        usually = (supported & seen).sum(0) / seen.sum(0).clip(1)
        choice = np.where(supported | (usually < USUALLY), choice, -1)
        at = np.arange(frames)
        picked = np.stack([found[at, k] * (k >= 0)[:, None, None] for found, k in zip(left, choice.T, strict=True)])
        tracks.append(PersonTrack(picked, claim, moves(picked)))
        for found, own in zip(left, picked, strict=True):
            found *= ~_same_place(own[:, None], found)[..., None, None]
    return tracks


def _most_prominent(camera: Camera, people: np.ndarray) -> np.ndarray:
    """Return a copy of people (frames, P, 25, 3) with the MAX_PAIRED most prominent of each frame, in their order."""
    best = np.argsort(-_prominence(camera, people), axis=1, kind="stable")[:, :MAX_PAIRED]
    return np.take_along_axis(people, np.sort(best, axis=1)[..., None, None], 1)


def moves(keypoints: np.ndarray) -> bool:
    """Return whether the parts of a person (C, frames, 25, 3) that move most do so by more than a detector's noise, in
    most of the cameras."""
    ranges = []
    for seen in keypoints:
        shown = seen[(seen[..., 2] > 0).any(-1)]
        if len(shown) == 0:
            continue
        at = np.where(shown[..., 2:] > 0, shown[..., :2], np.nan)[:, (shown[..., 2] > 0).any(0)]
        low, high = np.nanpercentile(at, (10, 90), axis=0)
        moved = np.percentile(np.linalg.norm(high - low, axis=-1), MOST_MOVING)
        ranges.append(moved / np.median(person_heights_px(shown)).clip(1))
    return bool(ranges) and float(np.median(ranges)) > STILL_SHARE


def _same_place(person: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return whether detections (..., 25, 3) show one person: the same detection, or the person detected twice."""
    both = np.minimum(person[..., 2], others[..., 2])
    distance = (np.linalg.norm(person[..., :2] - others[..., :2], axis=-1) * both).sum(-1) / both.sum(-1).clip(1e-9)
    height = np.maximum(person_heights_px(person), 1)
    return (both.sum(-1) > 0) & (distance <= SAME_SHARE * height)


class _Candidates(NamedTuple):
    """Combinations of people in one frame, the best first. picks (n, C): indices, -1 for nobody; supported (n, C): by
    other cameras; score (n,)."""

    picks: np.ndarray
    supported: np.ndarray
    score: np.ndarray


def _frame_candidates(cameras: list[Camera], people: list[np.ndarray]) -> _Candidates:
    """Return the best combinations of people in one frame, with and without people whom no other camera supports.

    people: per camera (P, 25, 3). The score is the mean over cameras of prominence times agreement.
    """
    prominence = [_prominence(camera, found) for camera, found in zip(cameras, people, strict=True)]
    agreements = _agreements(cameras, people) if len(cameras) > 1 else [np.eye(len(people[0]))]
    if len(agreements[0]) == 0:  # one camera alone shows somebody
        agreements = [np.zeros((1, len(found))) for found in people]
    picks = np.full((len(agreements[0]), len(cameras)), -1)
    scores, supported = np.zeros(picks.shape), np.zeros(picks.shape, bool)
    for c, agreement in enumerate(agreements):
        if not prominence[c].any():
            continue
        value = (UNSUPPORTED_WEIGHT + agreement) * prominence[c]
        picks[:, c] = value.argmax(1)
        scores[:, c] = value.max(1) / len(cameras)
        supported[:, c] = np.take_along_axis(agreement, picks[:, c : c + 1], 1)[:, 0] > MIN_SUPPORT
    nobody = np.full((1, len(cameras)), -1)
    picks = np.concatenate([picks, np.where(supported, picks, -1), nobody])
    total = np.concatenate([scores.sum(1), np.where(supported, scores, 0).sum(1), [0.0]])
    best = np.argsort(-total, kind="stable")
    _, first = np.unique(picks[best], axis=0, return_index=True)
    kept = best[np.sort(first)[:CANDIDATES]]
    return _Candidates(picks[kept], np.concatenate([supported, supported, nobody >= 0])[kept], total[kept])


def _agreements(cameras: list[Camera], people: list[np.ndarray]) -> list[np.ndarray]:
    """Return how well each hypothesis (a person in one camera is a certain person in another) explains each person: per
    camera (n, P), from 0 to 1."""
    projections = np.stack([camera.projection for camera in cameras])
    shown = [found[found[..., 2].any(1)] for found in people]
    hypotheses_m = [np.zeros((0, 25, 3))]
    for a, b in combinations(range(len(cameras)), 2):
        in_a, in_b = shown[a].repeat(len(shown[b]), axis=0), np.tile(shown[b], (len(shown[a]), 1, 1))
        views = np.stack([in_a.reshape(-1, 3), in_b.reshape(-1, 3)])
        hypotheses_m.append(solve_points(projections[[a, b]], views, confidence_of(views)).reshape(-1, 25, 3))
    points_m = np.concatenate(hypotheses_m)
    return [_support(camera, points_m, found) for camera, found in zip(cameras, people, strict=True)]


def _support(camera: Camera, points_m: np.ndarray, people: np.ndarray) -> np.ndarray:
    """Return the confidence-weighted share of each person's keypoints, people (P, 25, 3), onto which points (n, 25, 3)
    project: (n, P)."""
    uv, depth_m = camera.project(points_m)
    height_px = person_heights_px(people).clip(1)
    distance = np.linalg.norm(uv[:, None] - people[None, ..., :2], axis=-1) / height_px[:, None]
    hit = np.where((depth_m[:, None] > 0) & np.isfinite(distance), 1 - distance / AGREEMENT_REACH, 0).clip(0)
    weight = people[..., 2]
    return (hit * weight).sum(-1) / weight.sum(-1).clip(1e-9)


def person_heights_px(people: np.ndarray) -> np.ndarray:
    """Return the larger side of the box around each person's keypoints, (...,) of (..., 25, 3)."""
    visible = people[..., 2:] > 0
    low = np.where(visible, people[..., :2], np.inf).min(-2)
    high = np.where(visible, people[..., :2], -np.inf).max(-2)
    return (high - low).max(-1).clip(0)


def _prominence(camera: Camera, people: np.ndarray) -> np.ndarray:
    """Return size x confidence x centrality of each person, (P,), from 0 to 1."""
    size_px = np.array(camera.size_px)
    weight = people[..., 2:]
    centre = (people[..., :2] * weight).sum(-2) / weight.sum(-2).clip(1e-9)
    off_centre = np.linalg.norm((centre - size_px / 2) / size_px, axis=-1)
    height = (person_heights_px(people) / camera.height_px).clip(0, 1)
    return height * people[..., 2].mean(-1).clip(0, 1) * np.exp(-2 * off_centre**2)


def _most_probable_sequence(
    candidates: list[_Candidates], people: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the most probable sequence of combinations, (frames, C), which of its detections other cameras support,
    and its mean score: Viterbi with a cost for jumps in the image beyond what is typical of the recording. A person who
    is not seen stays where last seen."""
    shown = [_picked_keypoints([p[i] for p in people], found.picks) for i, found in enumerate(candidates)]
    steps = []
    for (was, now), (before, after) in zip(pairwise(shown), pairwise(candidates), strict=True):
        both = ((before.picks[0] >= 0) & (after.picks >= 0)).mean(1).clip(1e-9)
        jumps = _jump([one[:1] for one in was], now)[0] / both
        steps.append(jumps[after.score >= after.score[0] / 2].min())  # the best ones may show two people in turn
    free_jump = FREE_JUMPS * float(np.median(steps)) if steps else 0.0
    last, total, back = shown[0], candidates[0].score, []
    for now, (picks, _, score) in zip(shown[1:], candidates[1:], strict=True):
        best_before = total[:, None] - JUMP_COST * _jump(last, now, free_jump)
        back.append(best_before.argmax(0))
        total = best_before.max(0) + score
        seen = (picks >= 0).T[..., None, None]
        last = [np.where(is_seen, new, old[back[-1]]) for is_seen, new, old in zip(seen, now, last, strict=True)]
    path = [int(total.argmax())]
    for step in reversed(back):
        path.append(int(step[path[-1]]))
    on_path = list(zip(candidates, reversed(path), strict=True))
    picks, supported = (np.stack([found[part][k] for found, k in on_path]) for part in (0, 1))
    return picks, supported, float(np.mean([found.score[k] for found, k in on_path]))


def _picked_keypoints(people: list[np.ndarray], picks: np.ndarray) -> list[np.ndarray]:
    """Return per camera the keypoints (n, 25, 3) of the picked people of one frame, 0 for nobody."""
    return [np.where((pick >= 0)[:, None, None], found[pick], 0.0) for found, pick in zip(people, picks.T, strict=True)]


def _jump(before: list[np.ndarray], now: list[np.ndarray], free_jump: float = 0.0) -> np.ndarray:
    """Return the movement beyond `free_jump` in person heights, at most 1 per camera, averaged over cameras, from each
    of people (n, 25, 3) to each of others (m, 25, 3): (n, m)."""
    jumps = np.zeros((len(before[0]), len(now[0])))
    for was, is_now in zip(before, now, strict=True):
        a, b = was[:, None], is_now[None]
        both = np.minimum(a[..., 2], b[..., 2])
        distance = np.linalg.norm(a[..., :2] - b[..., :2], axis=-1) / person_heights_px(b).clip(1)[..., None]
        jumps += (((distance - free_jump).clip(0, 1) * both).sum(-1) / both.sum(-1).clip(1e-9)) / len(before)
    return jumps

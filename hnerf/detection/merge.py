"""A recording's own keypoints, and a network's where it has none."""

import numpy as np

from hnerf.capture.subject import person_heights_px

SAME = 0.15  # of a person's height: median distance of the keypoints of one person, found twice


def completed(own: np.ndarray, network: np.ndarray) -> np.ndarray:
    """The recording's people (P, 25, 3) of one image, with what they lack of the network's (Q, 25, 3), and the
    network's people in its place where the recording shows nobody. Pixels and confidence, 0 where absent."""
    if not (own[..., 2] > 0).any():
        return network
    filled = own.copy()
    for person in filled:
        other = _same_person(person, network)
        if other is not None:
            person[:] = np.where(person[:, 2:] > 0, person, other)
    return filled


def _same_person(person: np.ndarray, others: np.ndarray) -> np.ndarray | None:
    """Whoever of (Q, 25, 3) is nearest to a person (25, 3), if near enough to be the same."""
    best, nearest = None, SAME * float(person_heights_px(person[None])[0])
    for other in others:
        both = (person[:, 2] > 0) & (other[:, 2] > 0)
        if both.any():
            distance = float(np.median(np.linalg.norm(person[both, :2] - other[both, :2], axis=-1)))
            if distance <= nearest:
                best, nearest = other, distance
    return best


def stacked(people: list[np.ndarray]) -> np.ndarray:
    """(frames, most people, K, 3) of each frame's (P, K, 3); absent people are 0."""
    most = max(1, *(len(found) for found in people))
    rows = np.zeros((len(people), most, *people[0].shape[1:]))
    for row, found in zip(rows, people, strict=True):
        row[: len(found)] = found
    return rows

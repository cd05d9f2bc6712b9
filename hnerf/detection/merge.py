"""Completion of a recording's own keypoints with those of a network."""

import numpy as np

from hnerf.capture.people import person_heights_px

MATCH_SHARE = 0.15  # of a person's height: median keypoint distance up to which two detections are one person


def fill_missing(own: np.ndarray, network: np.ndarray) -> np.ndarray:
    """Return the recording's people (P, 25, 3) in one image, with missing keypoints taken from the network's people (Q,
    25, 3); the network's people if the recording has none. x_px, y_px, confidence; 0 where absent."""
    if not (own[..., 2] > 0).any():
        return network
    filled = own.copy()
    for person in filled:
        other = nearest_person(person, network)
        if other is not None:
            person[:] = np.where(person[:, 2:] > 0, person, network[other])
    return filled


def nearest_person(person: np.ndarray, others: np.ndarray) -> int | None:
    """Return the index of the one of (Q, 25, 3) nearest to a person (25, 3); None if none is near enough."""
    best, nearest = None, MATCH_SHARE * float(person_heights_px(person))
    for i, other in enumerate(others):
        both = (person[:, 2] > 0) & (other[:, 2] > 0)
        if both.any():
            distance = float(np.median(np.linalg.norm(person[both, :2] - other[both, :2], axis=-1)))
            if distance <= nearest:
                best, nearest = i, distance
    return best

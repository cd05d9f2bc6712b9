"""Faces: 468 points of a face, found by MediaPipe's face network (Kartynnik et al. 2019)."""

import threading

import numpy as np

from hnerf.detection.network import Network, sigmoid
from hnerf.models import FACE_LANDMARKS

SIZE, POINTS = 192, 468  # side of a crop in pixels; points of a face


class FaceNetwork(threading.local):
    """The face network, with its outputs decoded. Each thread loads its own: it is not safe to share."""

    def __init__(self) -> None:
        """Load the network. Raises InputError if its file is missing or altered."""
        self._network = Network(FACE_LANDMARKS)

    def __call__(self, crop: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the points (468, 2) of an upright face in a crop (192, 192, 3) uint8 RGB, in pixels from the
        crop's corner, and the probability that there is a face."""
        raw, presence = self._network(crop / 255)[:2]
        return raw.reshape(-1, 3)[:, :2].astype(np.float64), float(sigmoid(presence).item())

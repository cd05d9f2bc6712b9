"""BlazePose's detector (Bazarevsky et al. 2020): where there are people in an image, and how they stand."""

import numpy as np

from hnerf.detection.network import Network, probability
from hnerf.detection.region import Region, around, whole
from hnerf.models import POSE_DETECTOR

SIZE = 224
LAYERS = ((28, 2), (14, 2), (7, 6))  # cells on a side, and anchors in each
LEAST_SCORE = 0.5
SAME = 0.3  # IoU above which two boxes are of one person


def anchors() -> np.ndarray:
    """(2254, 2): middles of the cells that boxes are told from, in shares of the image, row by row."""
    layers = []
    for cells, count in LAYERS:
        middles = (np.arange(cells) + 0.5) / cells
        y, x = np.meshgrid(middles, middles, indexing="ij")
        layers.append(np.stack([x, y], -1).reshape(-1, 2).repeat(count, 0))
    return np.concatenate(layers)


def decoded(raw: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(n, 6, 2) in shares of the image: low and high corner, then four points, of the network's (n, 12) box middle,
    size and points in its pixels from anchors (n, 2)."""
    pairs = raw.reshape(-1, 6, 2) / SIZE
    middle, half = pairs[:, 0] + at, pairs[:, 1] / 2
    return np.concatenate([(middle - half)[:, None], (middle + half)[:, None], pairs[:, 2:] + at[:, None]], 1)


def merged(found: np.ndarray, scores: np.ndarray) -> list[np.ndarray]:
    """One (6, 2) a person, the surest first: the mean, weighted by score, of those that overlap with the best."""
    order = np.argsort(-scores, kind="stable")
    people = []
    while len(order):
        same = _iou(found[order[0], :2], found[order, :2]) > SAME
        same[0] = True
        people.append(np.average(found[order[same]], axis=0, weights=scores[order[same]]))
        order = order[~same]
    return people


def _iou(box: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Of a box (2, 2), low and high corner, with boxes (n, 2, 2)."""
    sides = np.minimum(box[1], boxes[:, 1]) - np.maximum(box[0], boxes[:, 0])
    common = sides.clip(0).prod(1)
    return common / ((box[1] - box[0]).prod() + (boxes[:, 1] - boxes[:, 0]).prod(1) - common)


class PersonDetector:
    """The network and what its outputs mean."""

    def __init__(self) -> None:
        self._network, self._anchors = Network(POSE_DETECTOR), anchors()

    def __call__(self, image: np.ndarray) -> list[Region]:
        """A region for each person in an image (H, W, 3) uint8 RGB, the surest first."""
        shown = whole(image.shape[1::-1])
        raw, logits = self._network(shown.crop(image, SIZE) / 127.5 - 1)
        scores = probability(logits[:, 0])
        sure = scores >= LEAST_SCORE
        from_crop = shown.from_crop(1)
        people = merged(decoded(raw[sure], self._anchors[sure]), scores[sure])
        return [around(*(person[2:4] @ from_crop[:, :2].T + from_crop[:, 2])) for person in people]

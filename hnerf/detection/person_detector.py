"""BlazePose's person detector (Bazarevsky et al. 2020): an upright region for each person in an image."""

import numpy as np

from hnerf.detection.network import Network, sigmoid
from hnerf.detection.region import Region, image_region, region_around
from hnerf.models import POSE_DETECTOR

SIZE = 224  # side of the network's input, px
LAYERS = ((28, 2), (14, 2), (7, 6))  # cells on a side, and anchors in each
MIN_SCORE = 0.5
NMS_IOU = 0.3  # IoU above which two boxes show one person


def anchors() -> np.ndarray:
    """Return the anchors of the boxes, (2254, 2): centres of the cells, as shares of the image, row by row."""
    layers = []
    for cells, count in LAYERS:
        middles = (np.arange(cells) + 0.5) / cells
        layers.append(np.stack(np.meshgrid(middles, middles), -1).reshape(-1, 2).repeat(count, 0))
    return np.concatenate(layers)


def decode_boxes(raw: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Decode boxes from the network's output (n, 12): centre, size and four points, in pixels relative to anchors (n,
    2).

    Returns (n, 6, 2), as shares of the image: low corner, high corner and the four points.
    """
    pairs = raw.reshape(-1, 6, 2) / SIZE
    middle, half = pairs[:, 0] + at, pairs[:, 1] / 2
    return np.concatenate([(middle - half)[:, None], (middle + half)[:, None], pairs[:, 2:] + at[:, None]], 1)


def weighted_nms(found: np.ndarray, scores: np.ndarray) -> list[np.ndarray]:
    """Return one box (6, 2) for each person, best score first: the mean, weighted by score, of boxes that overlap."""
    order = np.argsort(-scores, kind="stable")
    people = []
    while len(order):
        same = _iou(found[order[0], :2], found[order, :2]) > NMS_IOU
        same[0] = True
        people.append(np.average(found[order[same]], axis=0, weights=scores[order[same]]))
        order = order[~same]
    return people


def _iou(box: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return the intersection over union of a box (2, 2), low and high corner, with boxes (n, 2, 2): (n,)."""
    sides = np.minimum(box[1], boxes[:, 1]) - np.maximum(box[0], boxes[:, 0])
    common = sides.clip(0).prod(1)
    return common / ((box[1] - box[0]).prod() + (boxes[:, 1] - boxes[:, 0]).prod(1) - common)


class PersonDetector:
    """The detector's network, with its outputs decoded."""

    def __init__(self) -> None:
        self._network, self._anchors = Network(POSE_DETECTOR), anchors()

    def __call__(self, image: np.ndarray) -> list[Region]:
        """Return a region for each person in an image (H, W, 3) uint8 RGB, best score first."""
        shown = image_region(image.shape[1::-1])
        raw, logits = self._network(shown.crop(image, SIZE) / 127.5 - 1)
        scores = sigmoid(logits[:, 0])
        sure = scores >= MIN_SCORE
        people = weighted_nms(decode_boxes(raw[sure], self._anchors[sure]), scores[sure])
        return [region_around(*shown.to_image(person[2:4], 1)) for person in people]

"""BlazePose's landmark network: 33 keypoints of the person in a region, in pixels and in metres, and a soft mask."""

from typing import NamedTuple

import numpy as np

from hnerf.detection.network import Network, sigmoid
from hnerf.detection.region import Region, region_around

SIZE, POINTS = 256, 33  # followed by two auxiliary points, which determine the next region
HEAT_WINDOW, MIN_HEAT = 3, 0.5  # cells on each side of a point, and the minimum peak of the heat in them
MIN_PRESENCE = 0.5  # probability that a region shows a person; below it, nobody is there


class Person(NamedTuple):
    """A person found in an image. points_px: (33, 3) x, y, confidence; points_m: (33, 3) from the middle of the hips,
    in camera axes; mask: (256, 256) probability in `region`, which was searched; next: the region to search next."""

    points_px: np.ndarray
    points_m: np.ndarray
    mask: np.ndarray
    region: Region
    next: Region


class LandmarkNetwork:
    """The landmark network of one size, with its outputs decoded."""

    def __init__(self, size: str) -> None:
        """Load the network of a size: "heavy", "full" or "lite". Raises InputError if its file is missing or
        altered."""
        self._network = Network(f"pose_landmark_{size}.tflite")

    def __call__(self, image: np.ndarray, region: Region) -> Person | None:
        """Return the person in a region of an image (H, W, 3) uint8 RGB; None if nobody is there."""
        raw, presence, mask, heat, metric = self._network(region.crop(image, SIZE) / 255)
        if presence[0] < MIN_PRESENCE:
            return None
        points = raw.reshape(-1, 5).astype(np.float64)
        pixels = region.to_image(refine_by_heatmap(points[:, :2], sigmoid(heat)), SIZE)
        confidence = sigmoid(points[:POINTS, 3]) * sigmoid(points[:POINTS, 4])  # visible, and in the image
        points_m = region.to_camera_axes(metric.reshape(-1, 3)[:POINTS].astype(np.float64))
        points_px = np.column_stack([pixels[:POINTS], confidence])
        following = region_around(pixels[POINTS], pixels[POINTS + 1])
        return Person(points_px, points_m, sigmoid(mask[..., 0]).astype(np.float32), region, following)


def refine_by_heatmap(places: np.ndarray, heat: np.ndarray) -> np.ndarray:
    """Return places (n, 2) in the crop, moved to the weighted mean of the heatmap (h, w, n) around them if it is high
    there."""
    height, width = heat.shape[:2]
    moved = places.copy()
    for k, (x, y) in enumerate(places / SIZE * (width, height)):
        column, row = int(np.floor(x)), int(np.floor(y))
        if not (0 <= column < width and 0 <= row < height):
            continue
        rows = slice(max(row - HEAT_WINDOW, 0), row + HEAT_WINDOW + 1)
        columns = slice(max(column - HEAT_WINDOW, 0), column + HEAT_WINDOW + 1)
        window = heat[rows, columns, k]
        if window.max() >= MIN_HEAT:
            weights = window / window.sum()
            at = [
                columns.start + weights.sum(0) @ np.arange(window.shape[1]),
                rows.start + weights.sum(1) @ np.arange(window.shape[0]),
            ]
            moved[k] = np.array(at) * SIZE / (width, height)
    return moved

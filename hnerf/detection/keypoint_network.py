"""A top-down keypoint network from a user's own ONNX file: a crop around one person in, heatmaps or SimCC out.

Crops are made as these networks were trained: upright, with the aspect of the network's input, 1.25 times as large as
the person. Pixels of a crop have their centres at integers, as in MMPose.
"""

import math
from pathlib import Path

import numpy as np

from hnerf.capture.keypoint_sets import SETS, KeypointSetName, to_body_25
from hnerf.detection.landmarks import Person
from hnerf.detection.region import Region
from hnerf.errors import InputError
from hnerf.onnx_session import open_session, outputs_of

MEAN, STD = np.array([123.675, 116.28, 103.53]), np.array([58.395, 57.12, 57.375])  # of ImageNet's RGB values
PADDING = 1.25  # a crop's size over that of the box around the person
SETS_BY_POINTS: dict[int, KeypointSetName] = {17: "coco_17", 26: "halpe_26", 133: "coco_wholebody"}
KNOWN = ", ".join(map(str, SETS_BY_POINTS))
SMALLEST = 1e-10  # heat that counts as none


class KeypointNetwork:
    """A network with one input, RGB minus ImageNet's mean over its standard deviation, (1, 3, H, W) float32 of fixed H
    and W, and K keypoints as outputs: heatmaps (1, K, h, w), or SimCC (1, K, W r), (1, K, H r) for some r.

    K is the `points` of COCO-17, Halpe-26 or COCO-WholeBody.
    """

    def __init__(self, path: Path) -> None:
        """Load a network and try it on an image of the mean colour. Raises InputError if the file or ONNX Runtime is
        missing, or if the file is no such network."""
        self.path, self._session = path, open_session(path, "detection.model", threads=1)
        inputs = self._session.get_inputs()
        shape = inputs[0].shape
        fixed = len(shape) == 4 and shape[1] == 3 and all(isinstance(side, int) for side in shape[2:])
        if len(inputs) != 1 or not fixed or inputs[0].type != "tensor(float)":
            raise InputError(f"{path}: needs one float input (1, 3, H, W) of fixed H and W; it has {shape}")
        self.size_px: tuple[int, int] = (shape[3], shape[2])
        self.points = len(self._decoded(np.zeros((*shape[2:], 3))))

    def __call__(self, image: np.ndarray, person: Person) -> np.ndarray:
        """Return the keypoints (K, 3) of a person in an image (H, W, 3) uint8 RGB: x_px, y_px and confidence. Raises
        InputError if the network's output is not finite."""
        region, size = region_of(person, self.size_px), max(self.size_px)
        left, top = ((size - side) // 2 for side in self.size_px)
        crop = region.crop(image, size)[top : top + self.size_px[1], left : left + self.size_px[0]]
        points = self._decoded((crop - MEAN) / STD)
        points[:, :2] = region.to_image(points[:, :2] + [left + 0.5, top + 0.5], size)
        return points

    def _decoded(self, values: np.ndarray) -> np.ndarray:
        """Return the points (K, 3) for the input (H, W, 3): x, y in it and confidence."""
        given = np.ascontiguousarray(values.transpose(2, 0, 1)[None], np.float32)
        outputs = outputs_of(self._session, self.path, given, "export it for a batch of one image")
        shapes, (width, height) = [found.shape for found in outputs], self.size_px
        heat = len(shapes[0]) == 4 and min(shapes[0]) > 0 and min(shapes[0][2:]) > 1
        simcc = (
            [len(shape) for shape in shapes[:2]] == [3, 3]
            and shapes[0][:2] == shapes[1][:2]
            and shapes[0][2] * height == shapes[1][2] * width > 0
        )
        if not (heat or simcc) or shapes[0][0] != 1 or shapes[0][1] not in SETS_BY_POINTS:
            raise InputError(
                f"{self.path}: needs heatmaps (1, K, h, w) or SimCC (1, K, {width} r), (1, K, {height} r) as outputs, "
                f"of {KNOWN} points; it has {', '.join(map(str, shapes))}"
            )
        used = [found[0].astype(np.float64) for found in outputs[: 1 if heat else 2]]
        if not all(np.isfinite(found).all() for found in used):
            raise InputError(f"{self.path}: its output is not finite; check how it was exported")
        return from_heatmaps(used[0], self.size_px) if heat else from_simcc(used[0], used[1], self.size_px)

    def body_25(self, own: dict[str, np.ndarray], others: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the network's keypoints (frames, people, K, 3) by camera as BODY_25, with the points that its set
        lacks, such as feet, from `others` (frames, people, 25, 3), the same people."""
        name = SETS_BY_POINTS[self.points]
        lacks = np.array([not rows for rows in SETS[name].rows])[:, None]
        return {camera: np.where(lacks, others[camera], points) for camera, points in to_body_25(own, name).items()}


def region_of(person: Person, size_px: tuple[int, int]) -> Region:
    """Return the square region whose middle, of the aspect of `size_px`, is the crop around the person's landmarks."""
    angle = person.next.angle
    c, s = math.cos(angle), math.sin(angle)
    axes = np.array([[c, -s], [s, c]])  # columns: right and down in the region
    places = person.points_px[:, :2] @ axes
    low, high = places.min(0), places.max(0)
    scale = PADDING * float(np.max((high - low) / size_px))
    return Region(axes @ (low + high) / 2, scale * max(size_px), angle)


def from_heatmaps(maps: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Return the points (K, 3) of heatmaps (K, h, w): x, y in an input of (width, height) px, and the peak, in [0, 1].

    Outermost cells lie on the centres of the input's outermost pixels (UDP, Huang et al. 2020, as in ViTPose). A
    Gaussian through the peak and its neighbours gives fractions of a cell (DARK, Zhang et al. 2020).
    """
    count, rows, columns = maps.shape
    points = np.zeros((count, 3))
    for k, heat in enumerate(maps):
        row, column = divmod(int(heat.argmax()), columns)
        x, y = column + _from_peak(heat[row], column), row + _from_peak(heat[:, column], row)
        peak = heat[row, column].clip(0, 1)
        points[k] = x * (size_px[0] - 1) / (columns - 1), y * (size_px[1] - 1) / (rows - 1), peak
    return points


def _from_peak(line: np.ndarray, at: int) -> float:
    """Return how far beyond `at`, the highest of the values (n,) of a Gaussian, its middle lies; 0 at the ends."""
    if not 0 < at < len(line) - 1:
        return 0.0
    before, peak, after = np.log(line[at - 1 : at + 2].clip(SMALLEST))
    curvature = 2 * peak - before - after
    return float((after - before) / (2 * curvature)) if curvature > 0 else 0.0


def from_simcc(across: np.ndarray, down: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Return the points (K, 3) of SimCC's (K, W r) and (K, H r): x, y in an input of (W, H) px, and the lower of the
    two peaks, in [0, 1] (Li et al. 2022)."""
    ratio = across.shape[1] / size_px[0]
    peaks = np.minimum(across.max(1), down.max(1)).clip(0, 1)
    return np.column_stack([across.argmax(1) / ratio, down.argmax(1) / ratio, peaks])

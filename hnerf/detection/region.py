"""A square region of an image, turned so that a person in it stands upright: what a network is shown.

Networks count from a crop's corner: the middle of its first pixel is at (0.5, 0.5). Images have pixel centres at
integers.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np

SHRINK_BELOW = 0.75  # crop pixels an image pixel from which an image is averaged down first, against aliasing
MARGIN = 2.5  # side over the distance from a person's middle to the end of the circle around him


class Region(NamedTuple):
    """centre_px (2,) in the image; angle in radians, clockwise as seen, by which the region's own axes are turned."""

    centre_px: np.ndarray
    side_px: float
    angle: float

    def from_crop(self, size: int) -> np.ndarray:
        """(2, 3): the map from places in a crop of `size` x `size` to pixels of the image."""
        right = np.array([math.cos(self.angle), math.sin(self.angle)]) * self.side_px / size
        down = np.array([-right[1], right[0]])
        return np.column_stack([right, down, self.centre_px - (right + down) * size / 2])

    def crop(self, image: np.ndarray, size: int) -> np.ndarray:
        """(size, size, 3) uint8: the image (H, W, 3) there, black outside of it."""
        to_image = self.from_crop(size)
        to_image[:, 2] += to_image[:, :2].sum(1) / 2  # of pixel centres at integers
        if size < SHRINK_BELOW * self.side_px:
            full = np.array(image.shape[1::-1])
            small = np.maximum(1, np.round(full * size / self.side_px)).astype(int)
            image = cv2.resize(image, small.tolist(), interpolation=cv2.INTER_AREA)
            scale = small / full
            to_image[:, 2] = (to_image[:, 2] + 0.5) * scale - 0.5
            to_image[:, :2] *= scale[:, None]
        return cv2.warpAffine(image, to_image, (size, size), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)

    def paste(self, crop: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
        """(H, W): values of a crop (size, size) in an image of (width, height) px, 0 outside of the region."""
        to_image = self.from_crop(len(crop))
        to_image[:, 2] += to_image[:, :2].sum(1) / 2
        return cv2.warpAffine(crop, to_image, size_px, flags=cv2.INTER_LINEAR)

    def turned(self, directions: np.ndarray) -> np.ndarray:
        """Vectors (..., 3), right, down and away as the region's axes have it, along those of the camera."""
        c, s = math.cos(self.angle), math.sin(self.angle)
        return directions @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def around(middle_px: np.ndarray, end_px: np.ndarray) -> Region:
    """The region of a person of whom the middle of the hips is known, and the point above the head that is as far from
    it as the farthest of him."""
    across, up = end_px[0] - middle_px[0], middle_px[1] - end_px[1]
    return Region(middle_px, MARGIN * math.hypot(across, up), math.pi / 2 - math.atan2(up, across))


def whole(size_px: tuple[int, int]) -> Region:
    """The smallest region that holds an image of (width, height) px."""
    return Region((np.array(size_px) - 1) / 2, float(max(size_px)), 0.0)

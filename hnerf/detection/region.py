"""Square regions of an image, rotated so that a person in them is upright: the input of a network.

Networks count from a crop's corner: the middle of its first pixel is at (0.5, 0.5). Images have pixel centres at
integers.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np

SHRINK_BELOW = 0.75  # crop pixels per image pixel below which an image is first averaged down, against aliasing
MARGIN = 2.5  # a region's side over the radius of the circle around the person


class Region(NamedTuple):
    """A region. centre_px (2,): in the image; angle: of the region's axes, in radians, clockwise as seen."""

    centre_px: np.ndarray
    side_px: float
    angle: float

    def from_crop(self, size: int) -> np.ndarray:
        """Return the affine map (2, 3) from a crop of `size` x `size` to pixels of the image."""
        right = np.array([math.cos(self.angle), math.sin(self.angle)]) * self.side_px / size
        down = np.array([-right[1], right[0]])
        return np.column_stack([right, down, self.centre_px - (right + down) * size / 2])

    def to_image(self, places: np.ndarray, size: int) -> np.ndarray:
        """Return the pixels of the image for places (n, 2) in a crop of `size` x `size`."""
        from_crop = self.from_crop(size)
        return places @ from_crop[:, :2].T + from_crop[:, 2]

    def crop(self, image: np.ndarray, size: int) -> np.ndarray:
        """Resample the region of an image (H, W, 3) to (size, size, 3) uint8; black outside the image."""
        from_crop = self.from_crop(size)
        from_crop[:, 2] += from_crop[:, :2].sum(1) / 2  # pixel centres at integers
        if size < SHRINK_BELOW * self.side_px:
            full = np.array(image.shape[1::-1])
            small = np.maximum(1, np.round(full * size / self.side_px)).astype(int)
            image = cv2.resize(image, small.tolist(), interpolation=cv2.INTER_AREA)
            scale = small / full
            from_crop[:, 2] = (from_crop[:, 2] + 0.5) * scale - 0.5
            from_crop[:, :2] *= scale[:, None]
        return cv2.warpAffine(image, from_crop, (size, size), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)

    def paste(self, crop: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
        """Resample a crop (size, size) into an image of (width, height) px, (H, W); 0 outside the region."""
        from_crop = self.from_crop(len(crop))
        from_crop[:, 2] += from_crop[:, :2].sum(1) / 2
        return cv2.warpAffine(crop, from_crop, size_px, flags=cv2.INTER_LINEAR)

    def to_camera_axes(self, directions: np.ndarray) -> np.ndarray:
        """Rotate vectors (..., 3), right, down and away in the region, into the axes of the camera."""
        c, s = math.cos(self.angle), math.sin(self.angle)
        return directions @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def region_around(middle_px: np.ndarray, end_px: np.ndarray) -> Region:
    """Return the region around a person, given the middle of the hips and the point above the head at which the circle
    around the person ends."""
    up = end_px - middle_px
    return Region(middle_px, MARGIN * math.hypot(*up), upright_angle(up))


def upright_angle(up: np.ndarray) -> float:
    """Return the angle of a region whose upper side points in a direction `up` (2,) in the image."""
    return math.pi / 2 - math.atan2(-up[1], up[0])


def image_region(size_px: tuple[int, int]) -> Region:
    """Return the smallest region that contains an image of (width, height) px."""
    return Region((np.array(size_px) - 1) / 2, float(max(size_px)), 0.0)

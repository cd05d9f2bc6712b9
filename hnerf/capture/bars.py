"""Black bars: where the calibrated picture lies within a recorded image."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hnerf.capture.lens import Lens
from hnerf.geometry.camera import resampling

DARK = 16.0  # grey level: nine tenths of each row of a bar are below it
LIT = 40.0  # grey level: the median of the picture next to a bar must be above it, so that the edge shows
MAX_BAR_SHARE = 0.4  # of the image's side, for each of the two bars across it
RISE_PX = 3  # maximum width of the step from a bar to the picture; an encoder blurs it over two pixels
BAND_ROWS = 256  # image rows processed at once: whole images as floats would take gigabytes
ASPECT_PX = 1.0  # tolerated difference between the picture's height and what its width implies


class Area(NamedTuple):
    """A rectangle of an image in pixels, measured from the image's top left corner, half a pixel before the first pixel
    centre."""

    left: float
    top: float
    width: float
    height: float


def picture_area(pictures: Sequence[np.ndarray]) -> Area:
    """Return the part of one camera's frames (H, W, 3) uint8 that is not black bars, to a fraction of a pixel.

    A bar is dark in all frames and has a sharp edge; an image that fades to black has no bar.
    """
    starts = range(0, len(pictures[0]), BAND_ROWS)
    bands = ([picture[row : row + BAND_ROWS].mean(-1, dtype=np.float32) for picture in pictures] for row in starts)
    grey = np.concatenate([np.median(band, axis=0) for band in bands])
    top, bottom = _bar_px(grey), _bar_px(grey[::-1])
    left, right = _bar_px(grey.T), _bar_px(grey.T[::-1])
    height, width = grey.shape
    return Area(left, top, width - left - right, height - top - bottom)


def lens_for_area(lens: Lens, area: Area, recorded_px: tuple[int, int]) -> Lens | None:
    """Return the lens of a camera whose picture was scaled into `area` of the recorded image; None without proof of
    that.

    The proof is black bars and, between them, the calibrated aspect ratio to within a pixel. Distortion coefficients
    are in units of the focal length and do not change.
    """
    assert lens.size_px is not None
    sx, sy = area.width / lens.size_px[0], area.height / lens.size_px[1]
    if area == Area(0, 0, *recorded_px) or abs(area.height - sx * lens.size_px[1]) > ASPECT_PX:
        return None
    return dataclasses.replace(lens, K=resampling(sx, sy, area.left, area.top) @ lens.K)


def _bar_px(grey: np.ndarray) -> float:
    """Return the height of the bar at the top of a grey image (H, W), up to half of the picture's brightness; 0 without
    a bar."""
    limit = int(MAX_BAR_SHARE * len(grey))
    bright = np.flatnonzero(np.percentile(grey[:limit], 90, axis=1) >= DARK)
    if len(bright) == 0 or bright[0] == 0:
        return 0.0
    rows = np.median(grey[: bright[0] + 3 * RISE_PX], axis=1)
    half = float(np.median(rows[-RISE_PX:])) / 2
    above = int(np.argmax(rows > half))
    if half < LIT / 2 or above - bright[0] >= RISE_PX:
        return 0.0
    return above - float((rows[above] - half) / (rows[above] - rows[above - 1])) + 0.5

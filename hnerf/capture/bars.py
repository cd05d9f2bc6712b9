"""Black bars: where, within a recorded picture, the calibrated one lies."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hnerf.capture.lens import Lens

DARK = 16.0  # grey levels: nine tenths of a bar's row are below
LIT = 40.0  # grey levels: the median of the picture beside a bar is above, or its edge cannot be seen
WIDEST = 0.4  # of the picture's side, for each of two bars
RISE_PX = 3  # within which a bar must give way to the picture; an encoder blurs the edge over two
ASPECT_PX = 1.0  # by which the picture's height may differ from what its width says


class Area(NamedTuple):
    """A rectangle of an image in pixels from the image's top left corner, half a pixel before the first centre."""

    left: float
    top: float
    width: float
    height: float


def picture_area(pictures: Sequence[np.ndarray]) -> Area:
    """The part of (H, W, 3) uint8 frames of one camera that is not black bars, to a fraction of a pixel.

    A bar is dark in all frames and ends sharply; what fades into the dark is picture.
    """
    grey = np.median([picture.mean(-1) for picture in pictures], axis=0)
    top, bottom = _bar_px(grey), _bar_px(grey[::-1])
    left, right = _bar_px(grey.T), _bar_px(grey.T[::-1])
    height, width = grey.shape
    return Area(left, top, width - left - right, height - top - bottom)


def fitted(lens: Lens, area: Area, recorded_px: tuple[int, int]) -> Lens | None:
    """The lens of a camera whose picture was scaled into `area` of the recorded one; None where nothing proves that.

    Proof are bars, and within them the calibrated aspect to a pixel. Distortion coefficients are in units of the focal
    length, and stay.
    """
    assert lens.size_px is not None
    sx, sy = area.width / lens.size_px[0], area.height / lens.size_px[1]
    if area == Area(0, 0, *recorded_px) or abs(area.height - sx * lens.size_px[1]) > ASPECT_PX:
        return None
    to_recorded = np.array([[sx, 0, area.left + (sx - 1) / 2], [0, sy, area.top + (sy - 1) / 2], [0, 0, 1]])
    return dataclasses.replace(lens, K=to_recorded @ lens.K)


def _bar_px(grey: np.ndarray) -> float:
    """Height of the bar at the top of a picture (H, W), 0 if there is none: up to where half the light is reached."""
    limit = int(WIDEST * len(grey))
    bright = np.flatnonzero(np.percentile(grey[:limit], 90, axis=1) >= DARK)
    if len(bright) == 0 or bright[0] == 0:
        return 0.0
    rows = np.median(grey[: bright[0] + 3 * RISE_PX], axis=1)
    half = float(np.median(rows[-RISE_PX:])) / 2
    above = int(np.argmax(rows > half))
    if half < LIT / 2 or above - bright[0] >= RISE_PX:
        return 0.0
    return above - float((rows[above] - half) / (rows[above] - rows[above - 1])) + 0.5

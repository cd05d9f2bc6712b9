"""A stand-in for the networks that detect people."""

import numpy as np

from hnerf.detection.landmarks import Person
from hnerf.detection.region import Region


class MadeUp:
    """A network that sees one person with all points at (5, 4), except the right toe (32), which is outside the
    image."""

    seen = 0

    def __init__(self, *_: str) -> None: ...

    def __call__(self, image: np.ndarray, region: Region | None = None) -> list[Region] | Person:
        place = Region(np.array([5.0, 4.0]), 8.0, 0.0)
        if region is None:
            return [place]
        MadeUp.seen += 1
        points = np.tile([5.0, 4.0, 0.5], (33, 1))
        points[32] = 30, 4, 0.5
        return Person(points, np.zeros((33, 3)), np.ones((256, 256), np.float32), region, place)

"""Tracking of people through the images of one camera, with detection at intervals and when a track is lost."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from hnerf.detection.landmarks import Person
from hnerf.detection.region import Region

REDETECT_EVERY = 10  # images, to find people who have come in since
MISSING_FOR = 30  # images in each of which a lost person, hidden by another perhaps, is searched for
MAX_PASSES = 3  # in an image, as long as each finds the person elsewhere than in the searched region
MOVED, GREW = 0.1, 1.2  # shift in sides of the region, or factor on its side, beyond which it counts as elsewhere
MATCH_SHARE = 0.1  # of a region's side, an eighth of a height: distance below which two regions show one person

Detector = Callable[[np.ndarray], list[Region]]
Landmarks = Callable[[np.ndarray, Region], Person | None]


def track(images: Iterable[np.ndarray], detector: Detector, landmarks: Landmarks) -> Iterator[list[Person]]:
    """Yield the people in each image (H, W, 3) uint8 RGB, in the order of the images."""
    regions: list[Region] = []
    counts: deque[int] = deque(maxlen=MISSING_FOR)
    for i, image in enumerate(images):
        people = _located(image, regions, landmarks, [])
        if len(people) < max(counts, default=1) or i % REDETECT_EVERY == 0:
            people = _located(image, detector(image), landmarks, people)
        counts.append(max(1, len(people)))
        regions = [person.next for person in people]
        yield people


def _located(image: np.ndarray, regions: list[Region], landmarks: Landmarks, known: list[Person]) -> list[Person]:
    """Return the already known people and any others found in the regions."""
    people = list(known)
    for region in regions:
        person = None if any(_same(region, other.next) for other in people) else _settled(image, region, landmarks)
        if person and not any(_same(person.next, other.next) for other in people):
            people.append(person)
    return people


def _settled(image: np.ndarray, region: Region, landmarks: Landmarks) -> Person | None:
    person = landmarks(image, region)
    for _ in range(MAX_PASSES - 1):
        if person is None or not _elsewhere(person.region, person.next):
            break
        person = landmarks(image, person.next)
    return person


def _elsewhere(a: Region, b: Region) -> bool:
    moved = float(np.linalg.norm(b.centre_px - a.centre_px))
    return moved > MOVED * a.side_px or not 1 / GREW < b.side_px / a.side_px < GREW


def _same(a: Region, b: Region) -> bool:
    return float(np.linalg.norm(b.centre_px - a.centre_px)) < MATCH_SHARE * max(a.side_px, b.side_px)

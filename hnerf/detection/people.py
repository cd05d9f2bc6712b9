"""The chosen subject and the other people: check of the subject, masks, figures and an image for the report."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hnerf.capture.body_25 import FEET, LIMBS
from hnerf.capture.capture import PERSON, Capture, write_image
from hnerf.capture.people import PersonTrack, person_heights_px
from hnerf.detection.merge import nearest_person
from hnerf.detection.region import Region
from hnerf.errors import InputError

REPORT, PICTURE = "detection.json", "people.png"
MIN_HEIGHT_PX = 80  # in an image; the networks use 256 x 256 px around a person
WHOLE = (2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14)  # arms and legs, without which no pose is known
PICTURE_PX = 360  # height of each camera's image in PICTURE
GREEN, RED = (0, 200, 0), (220, 0, 0)


def check_subject(capture: Capture, subject: PersonTrack) -> None:
    """Raise InputError if the subject is too small in every camera, or cut by the border in every image."""
    seen = subject.keypoints[..., 2] > 0  # (C, frames, 25)
    heights = [person_heights_px(k[s.any(-1)]) for k, s in zip(subject.keypoints, seen, strict=True) if s.any()]
    tallest_px = max(float(np.median(px)) for px in heights)
    if tallest_px < MIN_HEIGHT_PX:
        shrunk = any(size_px != capture.cameras[name].size_px for name, size_px in capture.recorded_sizes_px.items())
        raise InputError(
            f"{capture.name}: the person is {tallest_px:.0f} px tall at most, and {MIN_HEIGHT_PX} are needed; record "
            f"from nearer by{', or raise capture.max_side_px in `hnerf run`' if shrunk else ''}"
        )
    by_any_camera = seen[..., WHOLE].any(0)  # (frames, 12)
    if not by_any_camera.all(-1).any():
        raise InputError(
            f"{capture.name}: the person is always cut off by the images' border; record from farther away, so that "
            "arms and legs are seen whole at least once"
        )


def keep_subject(
    out: Path, capture: Capture, camera: str, subject: np.ndarray, people: np.ndarray, found: dict[str, np.ndarray]
) -> None:
    """Rewrite the masks of those images of a camera that show other people, or that do not show the subject.

    subject (frames, 25, 3); people (frames, P, 25, 3): everybody whom the network found, in the order of their
    `regions` in `found` and, in images of several people, their `masks`, as `find_in_camera` stores them. A pixel more
    likely to show another person is not the subject's.
    """
    size_px = capture.cameras[camera].size_px
    for i, frame in enumerate(capture.frames):
        shown = np.flatnonzero((people[i, ..., 2] > 0).any(-1))
        own = nearest_person(subject[i], people[i])
        if len(shown) == 0 or (len(shown) == 1 and own is not None):
            continue
        likely = np.zeros(size_px[::-1], np.float32)
        if own is not None:
            likely = _pasted(found, i, own, size_px)
            for other in shown:
                likely = likely * (likely >= _pasted(found, i, int(other), size_px))
        write_image(out / PERSON / camera / f"{frame:06d}.png", likely.round().astype(np.uint8))


def _pasted(found: dict[str, np.ndarray], row: int, person: int, size_px: tuple[int, int]) -> np.ndarray:
    """Return a person's mask in the image, (H, W) float32 up to 255."""
    x, y, side_px, angle = found["regions"][row, person]
    region = Region(np.array([x, y]), side_px, angle)
    return region.paste(found["masks"][found["mask_rows"][row] + person].astype(np.float32), size_px)


def people_rows(people: list[PersonTrack]) -> list[dict[str, Any]]:
    """Return the report's values for each person, the subject first."""
    rows = []
    for i, person in enumerate(people):
        seen = np.asarray((person.keypoints[..., 2] > 0).any(-1))  # (C, frames)
        heights = person_heights_px(person.keypoints[seen])
        rows.append(
            {
                "person": "subject" if i == 0 else f"left {i}",
                "cameras": int(seen.any(1).sum()),
                "images": int(seen.sum()),
                "height_px": round(float(np.median(heights)), 1) if len(heights) else 0.0,
                "moves": person.moves,
                "claim": round(person.claim, 4),
            }
        )
    return rows


def draw_people(path: Path, capture: Capture, people: list[PersonTrack]) -> None:
    """Write, for each training camera, the image that shows most people, with the subject in green and others in
    red."""
    shown = np.stack([(person.keypoints[..., 2] > 0).any(-1) for person in people])  # (people, C, frames)
    tiles = []
    for c, camera in enumerate(capture.train_cameras):
        i = int((shown[:, c].sum(0) + 0.5 * shown[0, c]).argmax())
        picture = np.ascontiguousarray(capture.image(camera, capture.frames[i]))
        scale = PICTURE_PX / picture.shape[0]
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        for number, person in reversed(list(enumerate(people))):
            _draw_person(picture, person.keypoints[c, i] * [scale, scale, 1], RED if number else GREEN)
        cv2.putText(picture, f"{camera}, frame {capture.frames[i]}", (6, 16), 0, 0.45, (255, 255, 255), 2)
        cv2.putText(picture, f"{camera}, frame {capture.frames[i]}", (6, 16), 0, 0.45, (0, 0, 0), 1)
        tiles.append(picture)
    write_image(path, np.hstack(tiles))


def _draw_person(picture: np.ndarray, keypoints: np.ndarray, colour: tuple[int, int, int]) -> None:
    for a, b in LIMBS + FEET:
        if keypoints[a, 2] > 0 and keypoints[b, 2] > 0:
            ends = keypoints[[a, b], :2].round().astype(int).tolist()
            cv2.line(picture, ends[0], ends[1], colour, 2, cv2.LINE_AA)

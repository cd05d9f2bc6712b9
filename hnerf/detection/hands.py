"""Hands: 21 points of each of the subject's hands, given by the recording's files or the user's own keypoint network,
or found by MediaPipe's hand network (Zhang et al. 2020) where the forearm ends."""

import logging
import math
import threading
from pathlib import Path

import cv2
import numpy as np

from hnerf.capture.body_25 import LEFT_ARM, RIGHT_ARM
from hnerf.capture.capture import HANDS, Capture
from hnerf.capture.people import person_heights_px
from hnerf.capture.subject import subject_keypoints
from hnerf.capture.subset import write_points
from hnerf.detection.merge import nearest_person
from hnerf.detection.network import Network
from hnerf.detection.region import Region, upright_angle
from hnerf.files import copy_folder
from hnerf.models import HAND_LANDMARKS, has_model
from hnerf.progress import tracked
from hnerf.side_by_side import side_by_side

SIZE, POINTS = 224, 21
SIDES = (LEFT_ARM[1], RIGHT_ARM[1])  # elbow and wrist
WRISTS = [wrist for _, wrist in SIDES]
REACH, SIDE = 0.45, 1.2  # distance from wrist to middle of the hand, and side of the region, in forearm lengths
SHORTEST = 0.1  # forearm length in heights of the person: a forearm that points at the camera looks shorter
PASSES = 2  # the second searches where the first found the hand
PALM = [0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18]  # points that determine the next region
KNUCKLES = ([9], [5, 13])  # the hand's direction: half from the middle finger's, half from its neighbours'
AHEAD, AROUND = 0.1, 2.0  # of the next region: shift towards the finger tips, and side, in sizes of the palm
FAR = 0.5  # of the region's side: a hand whose wrist is farther from the body's wrist is another hand
SAME = 0.25  # of the region's side: median point distance below which two hands are the same one
FOUND = 0.5  # confidence of its surest point above which a hand counts as found, in the report

log = logging.getLogger("hnerf.hands")


def detect_hands(capture: Capture, out: Path) -> dict[str, float]:
    """Write the capture into `out` with the subject's hands in its training cameras; return the share of hands found by
    camera.

    The network, if it is installed, searches the cameras in which hands are not given for most frames that show the
    subject. Test cameras are never read. Raises InputError if the network is altered or there is no
    subject.
    """
    people = subject_keypoints(capture)
    hands = {name: given_hands(capture, name, keypoints) for name, keypoints in people.items()}
    own = [name for name, keypoints in people.items() if _in_most_frames(hands[name], keypoints)]
    if own:
        log.info("hands: given in %s", ", ".join(own))
    if len(own) < len(people) and has_model(HAND_LANDMARKS):
        hands |= _search(capture, {name: people[name] for name in people if name not in own})
    copy_folder(capture.root, out)
    write_points(out / HANDS, hands)
    return {name: float((points[..., 2].max(-1) > FOUND).mean()) for name, points in hands.items()}


def given_hands(capture: Capture, camera: str, subject: np.ndarray) -> np.ndarray:
    """Return the given hands (frames, 2, 21, 3), left and right, of the subject, keypoints (frames, 25, 3); 0 where
    there are none. Hands go with the wrists of a person whose left and right were exchanged."""
    hands = np.zeros((len(subject), 2, POINTS, 3))
    given, people = capture.given_hands(camera), capture.keypoints(camera)
    if given is None or people is None:
        return hands
    for i, keypoints in enumerate(subject):
        person = nearest_person(keypoints, people[i])
        if person is not None and person < given.shape[1]:  # others were added by a network
            wrists, as_found = keypoints[WRISTS], people[i][person][WRISTS]
            exchanged = not np.array_equal(wrists, as_found) and np.array_equal(wrists, as_found[::-1])
            hands[i] = given[i, person, ::-1] if exchanged else given[i, person]
    return hands


def _in_most_frames(hands: np.ndarray, subject: np.ndarray) -> bool:
    """Return whether most of the frames that show the subject (frames, 25, 3) have a point of a hand, (frames, 2, 21,
    3)."""
    shown, seen = (hands[..., 2] > 0).any((1, 2)), (subject[..., 2] > 0).any(1)
    return bool(2 * shown.sum() > seen.sum())


def _search(capture: Capture, people: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the hands (frames, 2, 21, 3) that the network finds in each of these cameras, given the subject's
    keypoints in them."""
    cv2.setNumThreads(1)
    network = HandNetwork()
    images = [(name, number) for name in people for number in range(len(capture.frames))]

    def find(image: tuple[str, int]) -> np.ndarray:
        name, number = image
        return find_hands(capture.image(name, capture.frames[number]), people[name][number], network)

    found = list(tracked(side_by_side(find, images), "hands", len(images)))
    stacked = np.stack(found).reshape(len(people), len(capture.frames), 2, POINTS, 3)
    return dict(zip(people, stacked, strict=True))


class HandNetwork(threading.local):
    """The hand network, with its outputs decoded. Each thread loads its own: it is not safe to share."""

    def __init__(self) -> None:
        """Load the network. Raises InputError if its file is missing or altered."""
        self._network = Network(HAND_LANDMARKS)

    def __call__(self, image: np.ndarray, region: Region) -> np.ndarray:
        """Return the points (21, 3) of the hand in a region of an image (H, W, 3) uint8 RGB: x_px, y_px and the
        probability that there is a hand."""
        raw, presence = self._network(region.crop(image, SIZE) / 255)[:2]
        pixels = region.to_image(raw.reshape(-1, 3)[:, :2].astype(np.float64), SIZE)
        return np.column_stack([pixels, np.full(POINTS, float(presence[0]))])


def find_hands(image: np.ndarray, keypoints: np.ndarray, network: HandNetwork) -> np.ndarray:
    """Return the left and the right hand, (2, 21, 3), of the person with BODY_25 keypoints (25, 3) in an image: x_px,
    y_px, confidence, which is 0 if the forearm is not seen or the points belong to something else."""
    hands = np.zeros((2, POINTS, 3))
    sides_px, height_px = np.zeros(2), float(person_heights_px(keypoints))
    for hand, (elbow, wrist) in enumerate(SIDES):
        if keypoints[[elbow, wrist], 2].min() <= 0:
            continue
        region = forearm_region(keypoints[elbow, :2], keypoints[wrist, :2], height_px)
        for _ in range(PASSES):
            points = network(image, region)
            region = hand_region(points[:, :2])
        sides_px[hand] = region.side_px
        if math.dist(points[0, :2], keypoints[wrist, :2]) < FAR * region.side_px:
            hands[hand] = points
    apart_px = float(np.median(np.linalg.norm(hands[0, :, :2] - hands[1, :, :2], axis=-1)))
    if (hands[..., 2] > 0).all() and apart_px < SAME * sides_px.max():
        wrists = keypoints[WRISTS, :2]
        hands[np.linalg.norm(hands[:, 0, :2] - wrists, axis=-1).argmax()] = 0
    return hands


def forearm_region(elbow_px: np.ndarray, wrist_px: np.ndarray, height_px: float) -> Region:
    """Return the region, fingers up, in which a forearm's hand must be. height_px: of the person in the image."""
    along = wrist_px - elbow_px
    length_px = float(np.linalg.norm(along))
    return Region(wrist_px + REACH * along, SIDE * max(length_px, SHORTEST * height_px), upright_angle(along))


def hand_region(points_px: np.ndarray) -> Region:
    """Return the region, fingers up, around points (21, 2) of a hand."""
    towards = np.mean([points_px[group].mean(0) for group in KNUCKLES], axis=0) - points_px[0]
    up = towards / max(float(np.linalg.norm(towards)), 1e-9)
    axes = np.stack([up, [-up[1], up[0]]])
    low, high = (limit(points_px[PALM] @ axes.T, axis=0) for limit in (np.min, np.max))
    size_px = max(float((high - low).max()), 1.0)
    return Region((low + high) / 2 @ axes + AHEAD * size_px * up, AROUND * size_px, upright_angle(up))

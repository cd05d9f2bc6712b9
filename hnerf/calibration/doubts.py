"""Checks of a recording against the person it shows: cameras may agree although all of them share a mistake."""

import logging

import numpy as np

from hnerf.calibration.diagnosis import GROSS_SHARE, crossed_points
from hnerf.capture.body_25 import EARS, Body25
from hnerf.capture.capture import Capture
from hnerf.capture.people import person_heights_px
from hnerf.errors import InputError
from hnerf.evenly_spaced import evenly_spaced
from hnerf.geometry.camera import Camera

log = logging.getLogger("hnerf.calibration")

MIN_PERSON_PX = 4.0  # minimum of a person's median height; below it, all keypoints are on one spot
MIN_UPRIGHT_COSINE = 0.5  # mean cosine between trunk and up; below it the person lies or bends, or `up` is wrong
EXCHANGED_COSINE = -0.3  # median cosine between left as labelled and as shown by face and feet, if sides are swapped
LOOKED_AT = 5  # frames of each camera, evenly spaced, whose keypoints are compared with the person's pixels
PLATE_DIFFERENCE = 30  # grey levels between image and clean plate that show the person
GAIN = 0.25  # share of keypoints that undoing a mistake brings onto the person
LOW_SHARE = 0.4  # of the other cameras' share; a mask of a half-hidden person still holds more keypoints than that
MAX_COVERED = 0.5  # of an image, by a person's mask; a larger mask is usually inverted, which segmentation refuses
MIN_IN_SIGHT = 0.05  # share of the person's keypoints within the images of a test camera
LEFT, RIGHT = (Body25.L_SHOULDER, Body25.L_HIP), (Body25.R_SHOULDER, Body25.R_HIP)
TOES, HEELS = (Body25.L_BIG_TOE, Body25.R_BIG_TOE), (Body25.L_HEEL, Body25.R_HEEL)


def check_spread(capture: Capture, keypoints: np.ndarray) -> None:
    """Raise InputError if all keypoints (C, frames, 25, 3) of a camera's person lie on one spot. Every camera shows the
    person."""
    for name, found in zip(capture.train_cameras, keypoints, strict=True):
        height_px = np.median(person_heights_px(found[(found[..., 2] > 0).any(1)]))
        if height_px < MIN_PERSON_PX:
            raise InputError(
                f"{capture.name}: camera {name}: keypoints of a person lie within {height_px:.1f} px; detect them again"
            )


def doubts(capture: Capture, keypoints: np.ndarray, points_m: np.ndarray | None) -> tuple[str, ...]:
    """Return in words what contradicts the recording, and log it. keypoints (C, frames, 25, 3) of the training cameras;
    points_m (frames, 25, 3), None with one camera."""
    found = doubts_about_pictures(capture, keypoints)
    if points_m is not None:
        crossed_m = crossed_points([capture.cameras[name] for name in capture.train_cameras], keypoints, points_m)
        found = [*_not_upright(crossed_m, capture.up), *exchanged_sides(crossed_m), *found]
        found += doubts_about_test_cameras(capture, points_m)
    for line in found:
        log.warning("%s: %s", capture.name, line)
    return tuple(found)


def _not_upright(points_m: np.ndarray, up: str) -> list[str]:
    """Return a doubt if the trunk, from mid-hip to neck, does not point along the world's `up`."""
    trunk = _direction(points_m[:, Body25.MID_HIP], points_m[:, Body25.NECK])
    trunk = trunk[np.isfinite(trunk).all(1)]
    if not len(trunk):
        return []
    mean = trunk.mean(0)
    if mean["xyz".index(up)] > MIN_UPRIGHT_COSINE:
        return []
    axis = int(np.abs(mean).argmax())
    found = f"{'-' if mean[axis] < 0 else '+'}{'xyz'[axis]}"
    return [
        f"the trunk mostly points along {found}, not up (+{up}): unless the person lies or bends, set up in "
        "capture.toml (y or z), or calibrate again with a world that stands upright"
    ]


def exchanged_sides(points_m: np.ndarray) -> list[str]:
    """Return a doubt if what is labelled left lies to the person's right.

    Face and feet show which way is forward whatever the labels are: from the ears' middle to the nose, and from heels
    to toes. Left is up x forward, with up from mid-hip to neck.
    """
    forward = _direction(points_m[:, EARS].mean(1), points_m[:, Body25.NOSE])
    feet = _direction(points_m[:, HEELS].mean(1), points_m[:, TOES].mean(1))
    forward = np.nan_to_num(forward) + np.nan_to_num(feet)
    up = _direction(points_m[:, Body25.MID_HIP], points_m[:, Body25.NECK])
    left = np.cross(up, forward)
    labelled = _direction(points_m[:, RIGHT].mean(1), points_m[:, LEFT].mean(1))
    cosine = (labelled * left).sum(1) / np.linalg.norm(left, axis=1).clip(1e-9)
    cosine = cosine[np.isfinite(cosine) & (np.linalg.norm(left, axis=1) > 0)]
    if not len(cosine) or np.median(cosine) > EXCHANGED_COSINE:
        return []
    return [
        "left and right are exchanged: by face and feet, the side that keypoints call left is the person's right; "
        "exchange them in the keypoint files, or detect again in pictures that are not mirrored"
    ]


def _direction(start_m: np.ndarray, end_m: np.ndarray) -> np.ndarray:
    """Return unit vectors (frames, 3), NaN where an end is not known."""
    return (end_m - start_m) / np.linalg.norm(end_m - start_m, axis=-1, keepdims=True).clip(1e-9)


def doubts_about_test_cameras(capture: Capture, points_m: np.ndarray) -> list[str]:
    """Return doubts about test cameras that do not see the person where the training cameras do, at points_m (frames,
    25, 3): all scores would be wrong. If a test camera has no keypoints, its images must show some of these points."""
    lines = []
    for name in capture.test_cameras:
        camera, people = capture.cameras[name], capture.keypoints(name)
        off = np.nan if people is None else _off_share(camera, points_m, people)
        if off > GROSS_SHARE:
            why = f"its keypoints lie {off:.0%} of the person's height from where the training cameras see them"
        elif np.isnan(off) and not _in_sight(camera, points_m):
            why = "where the training cameras see the person, its images show nothing or a dot"
        else:
            continue
        lines.append(
            f"camera {name}, for testing: {why}, so scores from it mean nothing; correct its calibration or its "
            "pictures, or leave it out"
        )
    return lines


def _off_share(camera: Camera, points_m: np.ndarray, people: np.ndarray) -> float:
    """Return the median distance in the image, as a share of the person's height, between points (frames, 25, 3) and
    the nearest of the people (frames, P, 25, 3); NaN if nobody is seen. Points behind the camera count as one height
    off."""
    uv, depth_m = camera.project(points_m)
    heights_px = person_heights_px(people)[..., None].clip(1)
    shares = np.linalg.norm(uv[:, None] - people[..., :2], axis=-1) / heights_px
    shares = np.where(depth_m[:, None] <= 0, 1.0, shares)
    known = (people[..., 2] > 0) & np.isfinite(points_m).all(-1)[:, None]
    off = np.ma.median(np.ma.masked_array(shares, ~known), axis=-1).filled(np.inf).min(1)
    off = off[np.isfinite(off)]
    return float(np.median(off)) if len(off) else np.nan


def _in_sight(camera: Camera, points_m: np.ndarray) -> bool:
    """Return whether some of the known points (..., 3) lie in the image, and not all on one spot."""
    known_m = points_m[np.isfinite(points_m).all(-1)]
    uv, depth_m = camera.project(known_m)
    inside = camera.holds(uv) & (depth_m > 0)
    if inside.sum() <= MIN_IN_SIGHT * len(known_m):
        return len(known_m) == 0
    return float(np.ptp(uv[inside], axis=0).max()) >= MIN_PERSON_PX


def doubts_about_pictures(capture: Capture, keypoints: np.ndarray) -> list[str]:
    """Return doubts if keypoints (C, frames, 25, 3) lie on the person only when they are mirrored left to right, or if
    a camera's keypoints were detected in images other than its own.

    A ring of cameras cannot tell: mirrored in all of them, a person is merely turned about the ring's axis. The
    person's pixels come from masks, either given or from a network, else from the difference to a clean plate.
    """
    rows = evenly_spaced(range(len(capture.frames)), LOOKED_AT)
    detected = dict(zip(capture.train_cameras, keypoints[:, rows], strict=True))
    people = {name: [_person(capture, name, capture.frames[row]) for row in rows] for name in detected}
    on = {name: _on(people[name], detected[name]) for name in detected}
    on = {name: hits for name, hits in on.items() if np.isfinite(hits).any()}
    mirrored = {name: _on(people[name], detected[name], mirrored=True) for name in on}
    share, share_mirrored = _share(*on.values()), _share(*mirrored.values())
    if share_mirrored > share + GAIN:
        return [
            f"{share:.0%} of the keypoints lie on the person, mirrored left to right {share_mirrored:.0%}: "
            "they belong to mirrored pictures; detect them again in these"
        ]
    shares, lines = {name: _share(hits) for name, hits in on.items()}, []
    for name in shares:
        rest = [other for other in shares if other != name]
        others = {f"those of camera {other}": np.nan_to_num(_on(people[name], detected[other])) for other in rest}
        undone = others | {"mirrored": mirrored[name], "in reverse order": _on(people[name][::-1], detected[name])}
        lines += _worse(name, shares, {what: _share(hits) for what, hits in undone.items()})
    return lines


def _worse(camera: str, shares: dict[str, float], undone: dict[str, float]) -> list[str]:
    """Return a doubt if far fewer of a camera's keypoints lie on the person than in other cameras, or than with a
    mistake undone. shares: by camera; undone: by mistake."""
    share, usual = shares[camera], float(np.median([shares[name] for name in shares if name != camera] or [0.0]))
    mistake = max(undone, key=lambda what: undone[what])
    if undone[mistake] > share + GAIN:
        compared = f"{mistake} {undone[mistake]:.0%}"
    elif share < LOW_SHARE * usual:
        compared = f"in other cameras {usual:.0%}"
    else:
        return []
    return [
        f"camera {camera}: {share:.0%} of the keypoints lie on the person, {compared}: they were detected in other "
        "images; correct its images, or detect again in these"
    ]


def _on(people: list[np.ndarray | None], keypoints: np.ndarray, mirrored: bool = False) -> np.ndarray:
    """Return whether each detected keypoint of (n, 25, 3) lies on the person in the n images, (m,); NaN outside the
    image."""
    hits = [np.zeros(0)]
    for person, points in zip(people, keypoints, strict=True):
        if person is not None:
            last = np.array(person.shape[::-1]) - 1
            at = points[points[:, 2] > 0, :2].round().astype(int)
            x, y = at.clip(0, last).T
            hits.append(np.where((at == np.stack([x, y], 1)).all(1), person[y, last[0] - x if mirrored else x], np.nan))
    return np.concatenate(hits)


def _share(*hits: np.ndarray) -> float:
    """Return the mean of the finite values; 0 if there are none."""
    known = np.concatenate([np.zeros(0), *hits])
    known = known[np.isfinite(known)]
    return float(known.mean()) if len(known) else 0.0


def _person(capture: Capture, camera: str, frame: int) -> np.ndarray | None:
    """Return which pixels show the person, (H, W) bool; None if that is not known."""
    mask = capture.given_mask(camera, frame)
    if mask is not None:
        return mask if mask.mean() < MAX_COVERED else None
    likely = capture.person_probability(camera, frame)
    if likely is not None:
        return likely > 0.5
    plate = capture.background(camera)
    if plate is None:
        return None
    return np.abs(capture.image(camera, frame).astype(int) - plate).max(-1) > PLATE_DIFFERENCE

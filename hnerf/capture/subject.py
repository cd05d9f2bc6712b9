"""Choice of the subject among detected people: the one seen by most cameras, longest and largest, or the one that
`capture.toml` names."""

import numpy as np

from hnerf.capture.body_25 import Body25
from hnerf.capture.capture import Capture, SubjectPoint
from hnerf.capture.lens import distort_points
from hnerf.capture.people import PersonTrack, follow_in_each_camera, follow_people, moves
from hnerf.capture.sides import put_sides_right
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera, resampling
from hnerf.geometry.triangulation import triangulate

EQUAL_CLAIM = 0.9  # share of the best claim above which another person could equally be meant
MIDDLE = (Body25.NECK, Body25.MID_HIP)  # where a person stands


def subject_keypoints(capture: Capture) -> dict[str, np.ndarray]:
    """Return the subject's keypoints in every training camera, (frames, 25, 3) in the order of `capture.frames`.

    Confidence is 0 where the person is not detected. Test cameras are never read. Raises InputError as `ranked_people`
    does.
    """
    return dict(zip(capture.train_cameras, ranked_people(capture)[0].keypoints, strict=True))


def ranked_people(capture: Capture) -> list[PersonTrack]:
    """Return the people in the training cameras, the subject first, with left and right as most cameras see them.

    The subject is the person that `capture.subject_point` names, else the one with the best claim
    (`hnerf.capture.people`) among those who move: a poster does not. Raises InputError if no frame shows a person in
    two cameras (in one, if there is only one), nobody is where the point is, or two people have an equal claim. Cameras
    that are all at one position are not calibrated yet; then each chooses separately.
    """
    people, cameras = _detected(capture), [capture.cameras[name] for name in capture.train_cameras]
    centres_m = np.stack([camera.centre_m for camera in cameras])
    uncalibrated = len(cameras) > 1 and bool((centres_m == centres_m[0]).all())
    subject, *others = _ranked(capture, cameras, people, uncalibrated)
    if len(cameras) > 1 and not uncalibrated:
        keypoints, exchanged = put_sides_right(cameras, subject.keypoints, np.array(capture.frames) / capture.fps)
        subject = subject._replace(keypoints=keypoints, exchanged=tuple(exchanged.sum(1).tolist()))
    return [subject, *others]


def _ranked(capture: Capture, cameras: list[Camera], people: list[np.ndarray], uncalibrated: bool) -> list[PersonTrack]:
    """Return what `ranked_people` does, with left and right as detected. people: those in each camera."""
    if all(found.shape[1] == 1 for found in people):
        alone = np.stack([found[:, 0] for found in people])
        return [PersonTrack(alone, 1.0, moves(alone))]
    tracks = (follow_in_each_camera if uncalibrated else follow_people)(cameras, people)
    if not tracks:
        raise InputError(f"{capture.name}: no person found in any frame; check the keypoint files")
    if point := capture.subject_point:
        _check_point(capture, point)
        distances = [_distance(capture, point, track) for track in tracks]
        order = np.argsort(distances, kind="stable")
        if not np.isfinite(distances[order[0]]):
            raise InputError(f"{capture.name}: capture.toml: subject: nobody is found there; name another point")
        return [tracks[i] for i in order]
    first, *others = sorted(tracks, key=lambda track: (track.moves, track.claim), reverse=True)
    if others and others[0].moves == first.moves and others[0].claim > EQUAL_CLAIM * first.claim:
        raise InputError(
            f"{capture.name}: two people have an equal claim to be the subject, {_place(capture, first, others[0])}; "
            'name one in capture.toml, as subject = "nearest to (x, y) in CAMERA at frame N"'
        )
    return [first, *others]


def _detected(capture: Capture) -> list[np.ndarray]:
    """Return the people in each training camera, (frames, P, 25, 3). Raises InputError if too few cameras have any."""
    names = capture.train_cameras
    people = []
    for name in names:
        found = capture.keypoints(name)
        if found is None:
            raise InputError(
                f"{capture.name}: camera {name}: no keypoints; set detection.source=network, or detect some"
            )
        people.append(np.where(np.isfinite(found).all(-1, keepdims=True), found, 0.0))
    seen = np.array([(p[..., 2] > 0).any((1, 2)) for p in people])  # (cameras, frames)
    if not (seen.sum(0) >= min(2, len(names))).any():
        raise InputError(f"{capture.name}: {_too_few(names, seen)}")
    return people


def _too_few(names: tuple[str, ...], seen: np.ndarray) -> str:
    """Return the message for cameras of which no two see somebody in the same frame. seen: (C, frames) bool."""
    by = [name for name, frames in zip(names, seen, strict=True) if frames.any()]
    if len(by) == 1 and len(names) > 1:
        return (
            f"no person found by any camera but {by[0]}, and two must see the person at once; correct the others' "
            f"keypoints or videos, or train on camera {by[0]} alone ([cameras] in capture.toml)"
        )
    return "no person found in any frame by enough cameras; check the keypoint files"


def _check_point(capture: Capture, point: SubjectPoint) -> None:
    """Raise InputError if the training cameras cannot tell how far people are from a point."""
    if not point.camera and len(capture.train_cameras) == 1:
        raise InputError(
            f"{capture.name}: capture.toml: subject: one camera tells no places on the ground; name a point in its "
            "image"
        )
    if point.camera and point.camera not in capture.train_cameras:
        raise InputError(
            f"{capture.name}: the subject is named in camera {point.camera}, which is left out; name another"
        )


def _distance(capture: Capture, point: SubjectPoint, person: PersonTrack) -> float:
    """Return how far a person is from a point: in metres on the ground, or in pixels of a camera; infinite where not
    seen."""
    if not point.camera:
        cameras = [capture.cameras[name] for name in capture.train_cameras]
        points_m, _, _ = triangulate(cameras, person.keypoints[:, :, MIDDLE])
        ground = points_m[..., ["xyz".index(axis) for axis in "xyz" if axis != capture.up]]
        known = ground[np.isfinite(ground).all(-1)]
        return float(np.linalg.norm(np.median(known, axis=0) - point.at)) if len(known) else np.inf
    frame = np.abs(np.array(capture.frames) - point.frame).argmin()  # the named frame may have been left out
    keypoints = person.keypoints[capture.train_cameras.index(point.camera), frame]
    seen = keypoints[keypoints[:, 2] > 0, :2]
    return float(np.linalg.norm(seen - point.at, axis=-1).min()) if len(seen) else np.inf


def _place(capture: Capture, *people: PersonTrack) -> str:
    """Return where people are in the first image that shows all of them, in words and recorded pixels."""
    shown = np.all([(person.keypoints[..., 2] > 0).any(-1) for person in people], axis=0)  # (C, frames)
    if not shown.any():
        return "in different images"
    c, frame = np.argwhere(shown)[0]
    camera, places = capture.cameras[capture.train_cameras[c]], []
    to_recorded = resampling(*(np.array(capture.recorded_sizes_px[camera.name]) / camera.size_px))
    for person in people:
        keypoints = person.keypoints[c, frame]
        x, y, _ = to_recorded @ [*np.median(keypoints[keypoints[:, 2] > 0, :2], axis=0), 1]
        if lens := capture.recorded_lens(camera.name):
            ((x, y),) = distort_points(np.array([[x, y]]), lens)
        places.append(f"({x:.0f}, {y:.0f})")
    return f"at {' and '.join(places)} in camera {camera.name}, frame {capture.frames[frame]}"

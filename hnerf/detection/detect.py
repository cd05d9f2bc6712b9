"""Detection of people in the training images of a capture: keypoints, landmarks in metres and soft masks."""

import dataclasses
import multiprocessing
import os
import time
import zlib
from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from itertools import tee
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import cv2
import numpy as np

from hnerf.capture.capture import GIVEN_HANDS, KEYPOINTS, LANDMARKS, PERSON, Capture, to_8_bit, write_image
from hnerf.capture.keypoint_files import pad_people
from hnerf.capture.keypoint_sets import hands_of, to_body_25
from hnerf.capture.subject import ranked_people
from hnerf.capture.subset import write_points
from hnerf.config import DetectionSettings
from hnerf.detection.keypoint_network import KeypointNetwork
from hnerf.detection.landmarks import POINTS, SIZE, LandmarkNetwork, Person
from hnerf.detection.merge import fill_missing
from hnerf.detection.people import PICTURE, REPORT, check_subject, draw_people, keep_subject, people_rows
from hnerf.detection.person_detector import PersonDetector
from hnerf.detection.tracker import track
from hnerf.errors import InputError
from hnerf.files import copy_folder
from hnerf.models import POSE_DETECTOR, model_file
from hnerf.processes import begin_worker
from hnerf.progress import report as report_progress
from hnerf.progress import tracked
from hnerf.results.files import write_result
from hnerf.results.preparation import DetectionReport

PROGRESS_S = 0.5  # between two counts of the finished images


def detect(capture: Capture, settings: DetectionSettings, out: Path) -> dict[str, Any]:
    """Write the capture into `out` with keypoints that a network finds in its training cameras; return the report, with
    `ms`, the milliseconds per image of each camera processed. No file contains `ms`, so that the same detections always
    give identical files.

    Cameras are distributed over as many processes as there are cores. Cameras whose landmarks are in `out` already are
    not processed again. Test cameras are never read, nor are training cameras of the capture's files that `capture`
    lacks. Masks show the subject only; keypoints are of all people, from whom `hnerf.capture.subject` chooses the
    subject. Raises PlaceError if a network is missing, and InputError if nobody is found in any image, the subject is
    ambiguous, or the subject is too small or always cut off.
    """
    for name in (POSE_DETECTOR, f"pose_landmark_{settings.size}.tflite"):
        model_file(name)
    network = None if settings.model is None else KeypointNetwork(settings.model)
    ms = _find_people(capture, settings, out)
    found = {name: _load(out, name, "points_px") for name in capture.train_cameras}
    people = to_body_25({name: people["points_px"] for name, people in found.items()}, "blazepose_33")
    hands = dict[str, np.ndarray]()
    if network is not None:
        own = {name: _load(out, name, "own_px")["own_px"] for name in people}
        people = network.body_25(own, people)
        hands = {name: points for name in own if (points := hands_of(own[name])) is not None}
    alone = settings.source == "network" or not capture.has_keypoints
    if alone and not any((points[..., 2] > 0).any() for points in people.values()):
        raise InputError(
            f"{capture.name}: nobody found in any image of the training cameras; a person must be seen from head to "
            "feet, upright, and be no smaller than a tenth of the image"
        )
    for name, points in (*people.items(), *hands.items()):  # those guessed outside the image count as not seen
        points *= capture.cameras[name].holds(points[..., :2])[..., None]
    copy_folder(capture.root, out)
    if alone:  # the people of the recording's own files are left out
        (out / GIVEN_HANDS).unlink(missing_ok=True)
        write_points(out / GIVEN_HANDS, hands)
    write_points(out / KEYPOINTS, people if alone else _with_own(capture, people))
    detected = Capture.load(out)
    ranked = ranked_people(detected)
    if alone:  # a recording's own keypoints may lack hidden parts
        check_subject(capture, ranked[0])
    subjects = dict(zip(detected.train_cameras, ranked[0].keypoints, strict=True))
    for name in capture.train_cameras:
        keep_subject(
            out, capture, name, subjects[name], people[name], _load(out, name, "masks", "mask_rows", "regions")
        )
    draw_people(out / PICTURE, detected, ranked)
    report = {"cameras": {name: _summary(people) for name, people in found.items()}, "people": people_rows(ranked)}
    write_result(out / REPORT, DetectionReport, report)
    return report | {"ms": ms}


def with_keypoints(capture: Capture, out: Path) -> Capture:
    """Return the capture if all training cameras have keypoints, else a copy in `out` with keypoints from the network
    for those that have none."""
    without = tuple(name for name in capture.train_cameras if capture.keypoints(name) is None)
    if not without:
        return capture
    detect(dataclasses.replace(capture, train_cameras=without), DetectionSettings(), out)
    return Capture.load(out)


def _with_own(capture: Capture, people: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the recording's own keypoints of people, completed by the network's."""
    own = {name: points for name in capture.cameras if (points := capture.keypoints(name)) is not None}
    filled = {
        name: pad_people([fill_missing(*pair) for pair in zip(own[name], points, strict=True)])
        for name, points in people.items()
        if name in own
    }
    return people | own | filled


def _find_people(capture: Capture, settings: DetectionSettings, out: Path) -> dict[str, float]:
    """Run `find_in_camera` for each camera without complete landmarks in `out`; return its results by camera."""
    waiting = [name for name in capture.train_cameras if not _is_whole(out / LANDMARKS / f"{name}.npz")]
    if len(waiting) < 2:
        return {name: find_in_camera(capture, name, settings, out) for name in waiting}
    processes = min(len(waiting), len(os.sched_getaffinity(0)))
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, spawn, initializer=begin_worker, initargs=(os.getpid(),)) as pool:
        jobs = {pool.submit(find_in_camera, capture, name, settings, out): name for name in waiting}
        running = set(jobs)
        try:
            while running:
                done, running = wait(running, PROGRESS_S, FIRST_EXCEPTION)
                for job in done:
                    job.result()
                images = sum(len(list((out / PERSON / name).glob("*.png"))) for name in jobs.values())
                report_progress("detection", images, len(jobs) * len(capture.frames))
        except BaseException:  # including SIGTERM and Ctrl-C: the pool would wait for all cameras
            for worker in multiprocessing.active_children():
                worker.terminate()
            raise
    return {name: job.result() for job, name in jobs.items()}


def find_in_camera(capture: Capture, camera: str, settings: DetectionSettings, out: Path) -> float:
    """Write one camera's masks, and then, atomically, `landmarks/<camera>.npz`; return the milliseconds per image.

    The file holds `points_px` (frames, people, 33, 3): x, y, confidence; `points_m` (frames, people, 33, 3); `regions`
    (frames, people, 4): centre x and y, side, angle; `masks` (M, 256, 256) uint8 in these regions, only of images with
    several people, from row `mask_rows` (frames,) on: twenty thousand images would fill the memory. With a keypoint
    network of the user's own also `own_px` (frames, people, K, 3), its points.
    """
    cv2.setNumThreads(1)
    started = time.perf_counter()
    network = None if settings.model is None else KeypointNetwork(settings.model)
    frames = tracked(capture.frames, "detection", len(capture.frames))
    images, again = tee(capture.image(camera, frame) for frame in frames)
    found = track(images, PersonDetector(), LandmarkNetwork(settings.size))
    everybody, masks, mask_rows, own = [], list[np.ndarray](), [], []
    for frame, image, people in zip(capture.frames, again, found, strict=True):
        if network is not None:
            own.append(np.array([network(image, person) for person in people]).reshape(-1, network.points, 3))
        write_image(out / PERSON / camera / f"{frame:06d}.png", _soft_mask(people, capture, camera))
        mask_rows.append(len(masks))
        masks += [to_8_bit(255 * person.mask) for person in people] if len(people) > 1 else []
        everybody.append([person._replace(mask=np.zeros(0)) for person in people])
    path = out / LANDMARKS / f"{camera}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(".partial")
    with beside.open("wb") as file:
        np.savez_compressed(
            file,
            points_px=_by_frame(everybody, lambda person: person.points_px, (POINTS, 3)),
            points_m=_by_frame(everybody, lambda person: person.points_m, (POINTS, 3)),
            masks=np.array(masks, np.uint8).reshape(-1, SIZE, SIZE),
            mask_rows=np.array(mask_rows),
            regions=_by_frame(everybody, lambda person: np.array([*person.region.centre_px, *person.region[1:]]), (4,)),
            **({} if network is None else {"own_px": pad_people(own)}),  # type: ignore[arg-type]
        )
    os.sync()  # the masks as well: this file's existence means that they are complete
    os.replace(beside, path)
    return 1e3 * (time.perf_counter() - started) / len(capture.frames)


def _by_frame(
    everybody: list[list[Person]], value: Callable[[Person], np.ndarray], shape: tuple[int, ...]
) -> np.ndarray:
    """Return a value of each person in each frame as one array (frames, people, *shape), 0 for absent people."""
    return pad_people([np.array([value(p) for p in people], float).reshape(-1, *shape) for people in everybody])


def _soft_mask(people: list[Person], capture: Capture, camera: str) -> np.ndarray:
    """Return 255 times the probability that a pixel shows a person, (H, W) uint8."""
    size_px = capture.cameras[camera].size_px
    likely = np.zeros(size_px[::-1], np.float32)
    for person in people:
        likely = np.maximum(likely, person.region.paste(person.mask, size_px))
    return to_8_bit(255 * likely)


def _is_whole(path: Path) -> bool:
    """Return whether a landmark file exists and is complete."""
    try:
        with ZipFile(path) as stored:
            return stored.testzip() is None
    except (OSError, EOFError, BadZipFile, zlib.error):
        return False


def _load(out: Path, camera: str, *names: str) -> dict[str, np.ndarray]:
    """Return the named arrays that `find_in_camera` stored; all masks would not fit into memory."""
    with np.load(out / LANDMARKS / f"{camera}.npz", allow_pickle=False) as stored:
        return {name: stored[name] for name in names}


def _summary(people: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the number of images, the number with somebody, and the most people in one image."""
    seen = np.any(people["points_px"][..., 2] > 0, axis=-1)  # (frames, people)
    return {"images": len(seen), "seen": int(seen.any(1).sum()), "people": int(seen.sum(1).max())}

"""The stages that detect people and their hands with networks."""

from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from hnerf.capture.capture import Capture
from hnerf.config import DetectionSettings
from hnerf.detection.detect import detect as detect_people
from hnerf.detection.hands import detect_hands
from hnerf.models import HAND_LANDMARKS, POSE_DETECTOR, has_model
from tasks.launcher import LostWorkerError
from tasks.stage import stage
from tasks.store import Artifact


@stage("detection", version="9", resumable=True)
def detect(out: Path, recording: Artifact, settings: DetectionSettings) -> dict[str, float]:
    """Write the recording with keypoints of its training cameras; resume after the cameras that an interrupted run
    finished."""
    try:
        report = detect_people(Capture.load(recording.root), settings, out)
    except BrokenProcessPool as error:
        raise LostWorkerError(f"a detection process ended: {error}") from error
    return {"slowest_ms": max(report["ms"].values())} if report["ms"] else {}


def needs_detection(recording: Artifact, settings: DetectionSettings) -> bool:
    """Return whether to run the network. It runs if the settings request it, or the recording has neither keypoints nor
    given poses. It also runs for a single camera, if it is installed, since it estimates the depth of limbs."""
    capture = Capture.load(recording.root)
    posed = capture.given_poses() is not None
    flat = len(capture.train_cameras) == 1 and not posed and has_model(POSE_DETECTOR)
    silent = not capture.has_keypoints and not posed
    return settings.source in ("network", "both") or (settings.source is None and (silent or flat))


@stage("hands", version="4", networks=(HAND_LANDMARKS,))
def find_hands(out: Path, recording: Artifact) -> dict[str, float]:
    """Write the recording with points of the subject's hands. Return the lowest share of hands found in any camera."""
    return {"least_found": min(detect_hands(Capture.load(recording.root), out).values())}


def needs_hands(recording: Artifact, settings: DetectionSettings) -> bool:
    """Return whether to look for hands: the settings allow it, the recording has hands or the network is installed,
    there are keypoints that locate the hands, and there are several cameras, which a fit of fingers needs."""
    capture = Capture.load(recording.root)
    found = settings.hands == "auto" and (capture.has_given_hands or has_model(HAND_LANDMARKS))
    return found and capture.has_keypoints and len(capture.train_cameras) > 1

"""The hands stage: points of the subject's hands, found by a network."""

from pathlib import Path

from hnerf.capture.capture import Capture
from hnerf.config import DetectionSettings
from hnerf.detection.hands import detect_hands
from hnerf.models import HAND_LANDMARKS, has_model
from tasks.stage import stage
from tasks.store import Artifact


@stage("hands", version="1")
def find_hands(out: Path, recording: Artifact) -> dict[str, float]:
    """Write the recording with the points of hands. Return the least share of hands found in a camera."""
    return {"least_found": min(detect_hands(Capture.load(recording.root), out).values())}


def needs_hands(recording: Artifact, settings: DetectionSettings) -> bool:
    """Return whether to look for hands: the settings allow it, the network is installed, keypoints say where, and
    several cameras see them, as a fit of fingers needs."""
    if settings.hands != "auto" or not has_model(HAND_LANDMARKS):
        return False
    capture = Capture.load(recording.root)
    return capture.has_keypoints and len(capture.train_cameras) > 1

import pytest

from hnerf.calibration import report
from hnerf.calibration.matches import Matches
from hnerf.calibration.silhouettes import Outlines


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable evidence from images, for synthetic captures that have none: keypoints are the only evidence. Nothing is
    drawn."""
    monkeypatch.setattr(Outlines, "of", lambda *_: None)
    monkeypatch.setattr(Matches, "of", lambda *_: Matches({}, 0))
    for draw in ("draw_cameras", "draw_evidence"):
        monkeypatch.setattr(report, draw, lambda *_: None)

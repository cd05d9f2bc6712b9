import pytest

from hnerf.calibration import report
from hnerf.calibration.matches import Matches
from hnerf.calibration.silhouettes import Outlines


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable evidence from images, for synthetic captures that have none: keypoints are the only evidence."""
    monkeypatch.setattr(Outlines, "of", lambda capture: None)
    monkeypatch.setattr(Matches, "of", lambda capture: Matches({}, 0))
    monkeypatch.setattr(report, "draw_evidence", lambda *arguments: None)

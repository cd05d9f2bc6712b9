import pytest

from hnerf.calibration import report
from hnerf.calibration.matches import Matches
from hnerf.calibration.silhouettes import Outlines


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """For made-up captures, which have no images: keypoints are the only evidence."""
    monkeypatch.setattr(Outlines, "of", lambda capture: None)
    monkeypatch.setattr(Matches, "of", lambda capture: Matches({}, 0))
    monkeypatch.setattr(report, "draw_evidence", lambda *arguments: None)

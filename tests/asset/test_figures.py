from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from hnerf.asset.figures import rig_figures
from hnerf.asset.rigs import FULL, GAME, StagedRig
from hnerf.asset.staging import CAPTURED, StagedAvatar


def test_rig_error_takes_each_point_in_its_worst_frame(staged: StagedAvatar, monkeypatch: pytest.MonkeyPatch) -> None:
    """The game rig is off by 1 mm in the first frame, and by 3 mm at one point in the second."""
    frames = len(staged.rigs[FULL].motions[CAPTURED].codes)
    off_m = np.zeros((frames, *staged.rest_points_m.shape))
    off_m[0, :, 0], off_m[1, 5, 1] = 0.001, -0.003

    def surfaces_m(rig: StagedRig, *_: Any) -> Iterator[np.ndarray]:
        yield from off_m if rig is staged.rigs[GAME] else np.zeros_like(off_m)

    monkeypatch.setattr(StagedRig, "surfaces_m", surfaces_m)
    found = rig_figures(staged, GAME)
    assert found["moved_p99_mm"] == pytest.approx(1) and found["moved_max_mm"] == pytest.approx(3)


def test_the_full_rig_is_not_posed_to_be_compared_with_itself(
    staged: StagedAvatar, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(StagedRig, "surfaces_m", lambda *_: pytest.fail("it was posed"))
    found = rig_figures(staged, FULL)
    assert (found["moved_p99_mm"], found["moved_max_mm"]) == (0, 0)

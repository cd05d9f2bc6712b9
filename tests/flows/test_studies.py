"""What ablations, benchmarks and stability studies have in common before their first training."""

from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import Mock

import pytest

from flows import ablations, benchmark, stability
from hnerf.errors import InputError

STUDIES = [(ablations, ablations.ablate), (benchmark, benchmark.benchmark), (stability, stability.stability)]


@pytest.mark.parametrize(("module", "study"), STUDIES)
def test_a_preset_that_leaves_a_camera_out_is_refused(
    module: ModuleType, study: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No study would train without the camera, and all figures could be null."""
    monkeypatch.setattr(module, "read_capture", Mock(side_effect=AssertionError))
    preset = tmp_path / "mine.yaml"
    preset.write_text("based_on: fast\nevaluation: {holdout: each}\n")
    chosen: dict[str, Any] = {"preset": str(preset)} if module is ablations else {"methods": [str(preset)]}
    with pytest.raises(InputError, match=r"^evaluation\.holdout: only `hnerf run` leaves cameras out; remove it$"):
        study.fn(tmp_path, store=tmp_path / "store", **chosen)

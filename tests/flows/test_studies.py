"""What ablations, benchmarks and stability studies have in common before their first training."""

import errno
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import Mock

import pytest

from flows import ablations, benchmark, stability
from hnerf.errors import InputError
from tasks.stage import RETRIES

Study = Callable[..., object]
STUDIES = [(ablations, ablations.ablate), (benchmark, benchmark.benchmark), (stability, stability.stability)]


@pytest.mark.parametrize(("module", "study"), STUDIES)
def test_an_error_of_input_or_output_while_the_recording_is_read_is_retried(
    module: ModuleType, study: Study, prefect_api: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[Path] = []

    def read_capture(folder: Path, store: Path) -> None:
        tried.append(folder)
        raise InputError("ada: is read") if len(tried) == 2 else OSError(errno.ESTALE, "Stale file handle")

    monkeypatch.setitem(RETRIES, "retry_delay_seconds", 0)
    monkeypatch.setattr(module, "read_capture", read_capture)
    with pytest.raises(InputError, match="ada: is read"):
        study(tmp_path, store=tmp_path / "store")
    assert tried == [tmp_path, tmp_path]


@pytest.mark.parametrize(("module", "study"), STUDIES)
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ("evaluation: {holdout: each}", r"evaluation\.holdout: only `hnerf run` leaves cameras out; remove it"),
        ("segmentation: {model: /no/a.onnx}", r"segmentation\.model: /no/a\.onnx: no such file; correct the path, or"),
    ],
)
def test_a_preset_that_no_study_can_use_is_refused_at_once(
    module: ModuleType, study: Any, settings: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No study would train without the camera, and all figures could be null."""
    monkeypatch.setattr(module, "read_capture", Mock(side_effect=AssertionError))
    preset = tmp_path / "mine.yaml"
    preset.write_text(f"based_on: fast\n{settings}\n")
    chosen: dict[str, Any] = {"preset": str(preset)} if module is ablations else {"methods": ["fast", str(preset)]}
    with pytest.raises(InputError, match=f"^{message}"):
        study.fn(tmp_path, store=tmp_path / "store", **chosen)

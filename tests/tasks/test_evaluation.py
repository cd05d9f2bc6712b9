"""The evaluation stage and the ground truth that is part of its key; the evaluation itself is fake."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hnerf.config import EvaluationSettings
from hnerf.errors import InputError
from tasks import evaluation as module
from tasks.source import read_capture
from tasks.store import Artifact, Store


def test_scores_are_stored_only_if_the_ground_truth_is_unchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The ground truth changes while the images are rendered."""
    mesh = tmp_path / "ada" / "ground_truth" / "mesh.ply"
    mesh.parent.mkdir(parents=True)
    mesh.write_text("true")

    def evaluate_avatar(*_: Any) -> dict[str, Any]:
        mesh.write_text("truer")
        return {"holdout": None, "novel_view": {"psnr": 30.0, "ssim": 0.9, "lpips": None}}

    for name, fake in {
        "evaluate_avatar": evaluate_avatar,
        "calibrated_capture": lambda *_: None,
        "load_avatar": lambda *_: None,
        "Masks": SimpleNamespace(load=lambda _: None),
        "BodyFit": SimpleNamespace(load=lambda _: None),
    }.items():
        monkeypatch.setattr(module, name, fake)
    store = Store(tmp_path / "store")
    earlier = [Artifact(stage=s, root=tmp_path / s, files={}) for s in "abcde"]

    def run() -> Artifact:
        return module.evaluate(store, read_capture(tmp_path / "ada")[1], *earlier, EvaluationSettings())

    with pytest.raises(InputError, match="ada/ground_truth: changed or moved since the command started"):
        run()
    assert run().metrics == {"novel_view psnr": 30.0, "novel_view ssim": 0.9}

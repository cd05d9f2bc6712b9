"""The fit stage, with a fake fit."""

from pathlib import Path

import pytest

from hnerf.config import FitSettings
from hnerf.results import FitReport
from tasks import fit as module
from tasks.store import Artifact, Store


class Body:
    """A fake body that is saved as one file."""

    def save(self, out: Path) -> None:
        (out / "body.npz").write_bytes(b"body")


def test_the_digest_of_a_fit_does_not_depend_on_its_duration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "calibrated_capture", lambda *_: None)
    given = Artifact(stage="capture", root=tmp_path, files={})

    def made(store: str, seconds: float) -> Artifact:
        empty: dict[str, list[float]] = {"keypoint_residual_px": [], "silhouette_iou": [], "keypoint_offsets_m": []}
        report = FitReport(seconds={"start": seconds}, frames=[], poor_frames=[], stature_m=1.8, beta={}, **empty)
        monkeypatch.setattr(module, "fit_body", lambda *_: (Body(), report))
        return module.fit(Store(tmp_path / store), given, given, None, FitSettings())

    quick, slow = made("a", 1.0), made("b", 2.0)
    assert quick.digest == slow.digest and slow.metrics == {"start": 2.0}

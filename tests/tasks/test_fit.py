"""The fit stage, with a fake fit."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from hnerf.config import FitSettings
from hnerf.models import FACE_LANDMARKS
from hnerf.results.preparation import FitReport
from tasks import fit as module
from tasks import stage
from tasks.store import Artifact, Store


def saved_as(name: str) -> SimpleNamespace:
    """Return a fake body that is saved as one file."""
    return SimpleNamespace(save=lambda out: (out / name).write_bytes(b"fitted"))


def report(seconds: float = 1.0) -> FitReport:
    empty: dict[str, list[float]] = {"keypoint_residual_px": [], "silhouette_iou": [], "keypoint_offsets_m": []}
    return FitReport(seconds={"start": seconds}, frames=[], poor_frames=[], stature_m=1.8, beta={}, **empty)


def test_the_digest_of_a_fit_does_not_depend_on_its_duration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "calibrated_capture", lambda *_: None)
    given = Artifact(stage="capture", root=tmp_path, files={})

    def made(store: str, seconds: float) -> Artifact:
        monkeypatch.setattr(module, "fit_body", lambda *_: (saved_as("body.npz"), report(seconds)))
        return module.fit(Store(tmp_path / store), given, given, None, FitSettings())

    quick, slow = made("a", 1.0), made("b", 2.0)
    assert quick.digest == slow.digest and slow.metrics == {"start": 2.0}


@pytest.mark.parametrize(("installed", "masked"), [(True, True), (False, True), (True, False)])
def test_a_face_is_fitted_with_masks_and_the_network(
    installed: bool,
    masked: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The fake face is saved as another file than the body. The artifact's key depends on the network, so it is not
    found in the store of the fit without."""
    given = Artifact(stage="capture", root=tmp_path / ("0" * 32), files={})
    monkeypatch.setattr(module, "calibrated_capture", lambda *_: None)
    monkeypatch.setattr(module.Masks, "load", lambda _: "masks")
    monkeypatch.setattr(module, "fit_body", lambda *_: (saved_as("body.npz"), report()))
    monkeypatch.setattr(module, "fit_face", lambda _, body: saved_as("face.npz"))
    store = Store(tmp_path / "store")
    caplog.set_level("INFO")
    for there in (not installed, installed):
        for where in (module, stage):
            monkeypatch.setattr(where, "has_model", lambda name, there=there: there and name == FACE_LANDMARKS)
        fitted = module.fit(store, given, given, given if masked else None, FitSettings())
    assert (fitted.root / "face.npz").exists() == (installed and masked)
    assert ("run `hnerf models`" in caplog.text) == masked

"""The stages of studies with a store, on a small synthetic capture."""

import json
from pathlib import Path

import pytest
import torch
import trimesh

from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.errors import InputError
from hnerf.study.degradations.catalogue import Degradation
from tasks import study as module
from tasks.capture import subset_capture
from tasks.source import read_capture
from tasks.store import Artifact, Store
from tasks.study import check_meshes, degrade_capture, degrade_fit
from tests.body.boxes import box_rig
from tests.study.recording import write_recording


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


def recording(store: Store) -> Artifact:
    return store.get_or_compute("capture", "ada", lambda out: {"cameras": len(write_recording(out).cameras)})


def body(store: Store) -> Artifact:
    """Return a body fit of the unit box in frames 2 and 4."""

    def write(out: Path) -> dict[str, float]:
        BodyFit(box_rig(), (2, 4), torch.zeros(2, 2, 3), torch.eye(4).repeat(2, 1, 1)).save(out)
        (out / "report.json").write_text("{}")
        return {}

    return store.get_or_compute("fit", "ada", write)


def test_the_selection_is_part_of_the_key_of_a_subset(store: Store) -> None:
    few = subset_capture(store, recording(store), ("01",), (2, 4), None)
    assert few.metrics == {"cameras": 2, "frames": 4}
    again = subset_capture(store, recording(store), ("01",), (2, 4), None)
    other = subset_capture(store, recording(store), ("02",), (2, 4), None)
    fewer = subset_capture(store, recording(store), ("01",), (2,), None)
    assert again.root == few.root
    assert len({few.root, other.root, fewer.root}) == 3


def test_strength_and_seed_are_part_of_the_key_of_a_degradation(store: Store) -> None:
    made = [
        degrade_capture(store, recording(store), Degradation(kind="image_noise", strength=strength, seed=seed))
        for strength, seed in ((5, 0), (5, 0), (6, 0), (5, 1))
    ]
    assert made[0].root == made[1].root
    assert len({artifact.root for artifact in made}) == 3
    assert Capture.load(made[0].root).train_cameras == ("01", "02")


def test_a_clothed_capture_is_stored_only_if_the_ground_truth_is_unchanged(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "calibrated_capture", lambda recording, _: Capture.load(recording.root))
    monkeypatch.setattr(Degradation, "apply", lambda *_, **__: None)
    worn, good = Degradation(kind="skirt", strength=0.1, seed=0), recording(store)
    mesh = tmp_path / "ada" / "ground_truth" / "meshes.npz"
    mesh.parent.mkdir(parents=True)
    truth = read_capture(tmp_path / "ada")[1]
    mesh.write_text("new")
    with pytest.raises(InputError, match="ada/ground_truth: changed"):
        module.degrade_clothing(store, truth, good, good, body(store), worn)
    module.degrade_clothing(store, read_capture(tmp_path / "ada")[1], good, good, body(store), worn)


def test_a_degraded_fit_has_the_report_of_the_original_fit(store: Store) -> None:
    bad = degrade_fit(store, body(store), Degradation(kind="wrong_shape", strength=20, seed=0))
    assert set(bad.files) == set(body(store).files) == {"body.npz", "rig.npz", "report.json"}
    assert not torch.equal(BodyFit.load(bad.root).rig.vertices_m, box_rig().vertices_m)


def test_a_surface_that_touches_itself_counts_as_closed(store: Store) -> None:
    """Two boxes touch at an edge; each has its own vertices there."""

    def write(out: Path) -> dict[str, float]:
        (out / "meshes").mkdir()
        small = trimesh.creation.box((0.1, 0.1, 1.0)).apply_translation((0.55, 0.55, 0))
        both = trimesh.util.concatenate([trimesh.creation.box((1.0, 1.0, 1.0)), small])
        both.export(out / "meshes" / "000002.ply")
        return {}

    checked = check_meshes(store, store.get_or_compute("evaluation", "twin", write), body(store))
    found = json.loads((checked.root / "surface.json").read_text())["000002"]
    assert found["fault"] is None
    assert (found["volume"], found["length"]) == pytest.approx((1.01, 1.1), rel=1e-4)


def test_meshes_are_compared_with_the_body_of_their_frame(store: Store) -> None:
    def write(out: Path) -> dict[str, float]:
        (out / "meshes").mkdir()
        for frame, side_m in ((2, 1.0), (4, 0.5)):
            trimesh.creation.box((side_m,) * 3).export(out / "meshes" / f"{frame:06d}.ply")
        return {}

    checked = check_meshes(store, store.get_or_compute("evaluation", "ada", write), body(store))
    found = json.loads((checked.root / "surface.json").read_text())
    assert found["000002"]["fault"] is None
    assert found["000004"]["fault"] == "surface has 0.12 of the body's volume"
    assert found["000004"]["volume"] == pytest.approx(0.125)
    assert checked.metrics == {"faults": 1}

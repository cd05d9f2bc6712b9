"""The order of the stages in the flow, with fake stages that record their inputs."""

import errno
import inspect
import json
import subprocess
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from fsspec import filesystem

from flows import preparation
from flows import train_subject as module
from flows.train_subject import train_subject
from hnerf.capture.capture import Capture
from hnerf.config import load_settings
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera
from tasks import store
from tasks.stage import Stage
from tasks.store import Artifact

IN_A_THREAD = """
import threading

def load():
    import flows.train_subject

thread = threading.Thread(target=load)
thread.start()
thread.join()
"""
STAGES = (
    "find_cameras",
    "ingest",
    "detect",
    "find_hands",
    "calibrate",
    "segment",
    "fit",
    "train",
    "evaluate",
    "export",
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write a capture folder and replace every stage of the flow by one that records its input artifacts."""

    def write(_: str, out: Path, **inputs: Any) -> dict[str, float]:
        still = load_settings("idr" if (tmp_path / "ada" / "still").exists() else "fast").training
        (out / "settings.json").write_text(json.dumps({"static": False, "training": still.model_dump()}))
        (out / "given.json").write_text(json.dumps([v.stage for v in inputs.values() if isinstance(v, Artifact)]))
        camera = Camera("1", np.eye(3), np.eye(3), np.zeros(3), 4, 4)
        Capture("ada", out, {"1": camera}, ("1",), (), (0,), (), 25.0, "z", {"1": (4, 4)}, {"1": (4, 4)}).save()
        return {}

    replace_stages(monkeypatch, STAGES, write)
    monkeypatch.setattr(preparation, "lacks_calibration", lambda path: (path / "uncalibrated").exists())
    monkeypatch.setattr(preparation, "needs_body", lambda *_: (tmp_path / "ada" / "bare").exists())
    monkeypatch.setattr(preparation, "needs_detection", lambda *_: (tmp_path / "ada" / "undetected").exists())
    monkeypatch.setattr(preparation, "needs_hands", lambda *_: (tmp_path / "ada" / "handed").exists())
    (tmp_path / "ada").mkdir()
    return tmp_path / "ada"


def replace_stages(patch: pytest.MonkeyPatch, names: Iterable[str], write: Callable[..., dict[str, float]]) -> None:
    """Replace stages by fakes of the same name and parameters, which call `write` with that name first."""
    for place in (preparation, module):
        for name in set(names) & set(vars(place)):
            stage = getattr(place, name)
            fake = partial(write, stage.name)
            fake.__signature__ = inspect.signature(stage.write)
            patch.setattr(place, name, Stage(fake, stage.name, "test"))


def given(subject: Path, stage: str) -> list[str]:
    return json.loads((subject / stage / "given.json").read_text())


def test_a_process_that_imports_the_flow_outside_its_main_thread_ends_well() -> None:
    """Prefect does that after a run was cancelled or crashed, and a worker waits for the end of that process."""
    ended = subprocess.run([sys.executable, "-c", IN_A_THREAD], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_every_stage_is_linked_and_gets_the_results_of_earlier_stages(folder: Path, tmp_path: Path) -> None:
    subject = train_subject.fn(folder, "demo", tmp_path / "store", []).subject
    assert subject == tmp_path / "store" / "subjects" / "ada"
    assert given(subject, "segmentation") == ["capture", "calibration"]
    assert given(subject, "fit") == ["capture", "calibration", "segmentation"]
    assert given(subject, "training") == ["capture", "calibration", "segmentation", "fit"]
    assert given(subject, "evaluation") == ["capture", "calibration", "segmentation", "fit", "training"]
    assert given(subject, "asset") == ["capture", "calibration", "segmentation", "training"]


def test_what_was_made_before_a_stage_fails_is_linked(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "train", Mock(side_effect=InputError("the surface is empty")))
    with pytest.raises(InputError, match="the surface is empty"):
        train_subject.fn(folder, "demo", tmp_path / "store", [])
    linked = {path.name for path in (tmp_path / "store" / "subjects" / "ada").iterdir() if path.is_symlink()}
    assert linked == {"capture", "calibration", "segmentation", "fit"}


def test_a_field_that_cannot_be_posed_has_no_asset(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (folder / "still").touch()
    trained = train_subject.fn(folder, "demo", tmp_path / "store", [])
    assert trained.asset is None and "no asset: IDR models one moment" in caplog.text
    assert (trained.subject / "evaluation").exists() and not (trained.subject / "asset").exists()


def test_a_capture_in_a_bucket_is_fetched(folder: Path, s3: str, tmp_path: Path) -> None:
    url = f"{s3}-{tmp_path.name}/ada"
    filesystem("s3").pipe(f"{url}/intri.yml", b"cameras")
    trained = train_subject.fn(url, "demo", tmp_path / "store", [])
    assert given(trained.subject, "fit") == ["capture", "calibration", "segmentation"]
    assert [path.read_text() for path in (tmp_path / "store" / "fetched").glob("*/ada/intri.yml")] == ["cameras"]
    assert (trained.subject / ".recording").read_text().splitlines()[1] == url


def test_the_first_look_at_a_capture_is_retried_too(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stale, exists = [OSError(errno.ESTALE, "Stale file handle")], Path.exists

    def look(path: Path) -> bool:
        if path == folder and stale:
            raise stale.pop()
        return exists(path)

    def tried_twice(read: Callable[..., Any]) -> Callable[..., Any]:
        def read_twice(*given: object) -> Any:
            try:
                return read(*given)
            except OSError:
                return read(*given)

        return read_twice

    monkeypatch.setattr(Path, "exists", look)
    monkeypatch.setattr(module, "retried", tried_twice)
    train_subject.fn(folder, "demo", tmp_path / "store", [])
    assert not stale


@pytest.mark.parametrize(("mark", "stage"), [("undetected", "detection"), ("handed", "hands")])
def test_later_stages_get_the_detections_in_place_of_the_recording(
    folder: Path, tmp_path: Path, mark: str, stage: str
) -> None:
    (folder / mark).touch()
    subject = train_subject.fn(folder, "demo", tmp_path / "store", []).subject
    assert given(subject, stage) == ["capture"]
    assert given(subject, "calibration") == [stage]
    assert given(subject, "training") == [stage, "calibration", "segmentation", "fit"]
    assert given(subject, "asset") == [stage, "calibration", "segmentation", "training"]


def test_cameras_found_from_the_person_are_linked_until_the_folder_has_its_own(folder: Path, tmp_path: Path) -> None:
    (folder / "uncalibrated").touch()
    subject = train_subject.fn(folder, "demo", tmp_path / "store", []).subject
    assert given(subject, "cameras") == [] and given(subject, "capture") == ["cameras"]
    assert (subject / "asset").exists()
    (folder / "uncalibrated").unlink()
    assert train_subject.fn(folder, "demo", tmp_path / "store", []).subject == subject
    assert given(subject, "capture") == [] and not (subject / "cameras").is_symlink()


def test_a_keypoint_network_of_the_users_own_counts_by_its_bytes(folder: Path, tmp_path: Path) -> None:
    (folder / "undetected").touch()
    made = []
    for name, content in (("a.onnx", "one"), ("b.onnx", "one"), ("c.onnx", "two")):
        (tmp_path / name).write_text(content)
        subject = train_subject.fn(folder, "demo", tmp_path / "store", [f"detection.model={tmp_path / name}"]).subject
        assert given(subject, "calibration") == ["detection"]
        made.append((subject / "detection").resolve())
    made.append((train_subject.fn(folder, "demo", tmp_path / "store", []).subject / "detection").resolve())
    assert made[0] == made[1] and len(set(made)) == 3


def test_a_file_that_a_setting_misspells_is_refused_before_any_stage(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^detection\.model: absent\.onnx: no such file"):
        train_subject.fn(folder, "fast", tmp_path / "store", ["detection.model=absent.onnx"])
    assert not (tmp_path / "store").exists()


def test_stages_that_a_run_skips_are_not_linked(folder: Path, tmp_path: Path) -> None:
    """The recording's own files are the same in both runs."""
    for name in ("undetected", "handed"):
        (folder / name).touch()
    assert (train_subject.fn(folder, "demo", tmp_path / "store", []).subject / "hands").exists()
    (folder / "handed").rename(folder / "bared")
    (folder / "undetected").rename(folder / "detected")
    subject = train_subject.fn(folder, "demo", tmp_path / "store", []).subject
    assert not {"detection", "hands"} & {path.name for path in subject.iterdir()}


def test_the_store_knows_every_stage_that_a_subject_links_to() -> None:
    flow = vars(preparation) | vars(module)
    unlinked = {"subset", "holdout"}
    assert {one.name for one in flow.values() if isinstance(one, Stage)} - unlinked == set(store.STAGES)
    assert [flow[name].name for name in STAGES] == list(store.STAGES)


def test_without_masks_or_plates_a_rough_fit_precedes_segmentation(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "bare").touch()
    monkeypatch.setattr(preparation, "converged", lambda *_: True)
    subject = train_subject.fn(folder, "demo", tmp_path / "store", []).subject
    assert given(subject, "segmentation") == ["capture", "calibration", "fit"]
    assert given(subject, "fit") == ["capture", "calibration", "segmentation"]
    assert len(list((tmp_path / "store" / "fit").glob("*/given.json"))) == 2


def test_fit_and_segmentation_alternate_until_the_masks_converge(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "bare").touch()
    answers = iter([False, True])
    monkeypatch.setattr(preparation, "converged", lambda *_: next(answers))
    subject = train_subject.fn(folder, "demo", tmp_path / "store", []).subject
    assert given(subject, "segmentation") == ["capture", "calibration", "fit", "segmentation"]
    assert next(answers, None) is None
    assert len(list((tmp_path / "store" / "segmentation").glob("*/given.json"))) == 2


def test_the_number_of_rounds_is_limited(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "bare").touch()
    asked = []
    monkeypatch.setattr(preparation, "converged", lambda *_: bool(asked.append(1)))
    train_subject.fn(folder, "demo", tmp_path / "store", ["segmentation.rounds=2"])
    assert len(asked) == 2


def test_a_run_returns_its_own_results_even_if_another_run_ends_last(folder: Path, tmp_path: Path) -> None:
    first = train_subject.fn(folder, "demo", tmp_path / "store", [])
    second = train_subject.fn(folder, "demo", tmp_path / "store", ["evaluation.report_rows=7"])
    assert first.report != second.report and first.asset == second.asset and first.subject == second.subject
    assert (second.subject / "evaluation").resolve() == second.report.parent
    assert (first.report.parent / "given.json").exists()


def test_hands_detected_by_a_concurrent_run_are_not_linked(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both runs have the same recording, but different settings."""
    evaluate = module.evaluate

    def linked(artifact_store: store.Store, *inputs: Any) -> Artifact:
        artifact_store.link_latest("ada", artifact_store.get_or_compute("hands", "k", lambda out: {}))
        return evaluate(artifact_store, *inputs)

    monkeypatch.setattr(module, "evaluate", linked)
    subject = train_subject.fn(folder, "demo", tmp_path / "store", []).subject
    assert {path.name for path in subject.iterdir() if path.is_symlink()} == set(store.STAGES) - store.OPTIONAL


def test_detected_hands_stay_linked_when_an_earlier_run_detected_people(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An earlier run detected people. This one uses the recording's keypoints, detects hands, and is interrupted."""
    artifacts = store.Store(tmp_path / "store")

    def hands(artifact_store: store.Store, *_: Any) -> Artifact:
        artifact_store.link_latest("ada", artifact_store.get_or_compute("detection", "k", lambda out: {}))
        return artifact_store.get_or_compute("hands", "k", lambda out: {})

    monkeypatch.setattr(module, "with_detections", hands)
    monkeypatch.setattr(module, "calibrate", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        train_subject.fn(folder, "demo", tmp_path / "store", [])
    linked = artifacts.subject_folder("ada")
    assert {path.name for path in linked.iterdir() if path.is_symlink()} == {"capture", "hands"}

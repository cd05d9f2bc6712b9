"""The stability flow with fake stages: which stages get degraded inputs, and the verdicts on failing runs."""

import base64
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import torch

from flows import preparation, run_page
from flows import stability as module
from flows.cli import main
from flows.stability import stability
from hnerf.errors import InputError, NotApplicableError, PlaceError
from hnerf.study.stability.charts import curve_chart, matrix_chart
from tasks.launcher import LostWorkerError

pytestmark = pytest.mark.usefixtures("stages")

STUDY = """
methods: [fast]
seeds: [0, 1]
degradations:
  image_noise: [5, 40]
  skirt: [0.02]
  mask_eroded: [1]
  pose_noise: [2]
  learning_rate_up: [10]
  extreme_poses: [45, 60]
"""


@pytest.fixture
def stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Replace every stage by a fake that names its input; return the list that collects the inputs of each training.

    Calibration refuses noise of 40; eroded masks crash the training; pose noise costs 2 dB; the surface breaks in poses
    of 60 degrees. Charts are empty files.
    """
    trained: list[dict[str, Any]] = []

    def made(name: str, **files: Any) -> Any:
        folder = tmp_path / "made" / name
        folder.mkdir(parents=True, exist_ok=True)
        for file, content in files.items():
            (folder / f"{file}.json").write_text(json.dumps(content))
        return SimpleNamespace(root=folder, name=name)

    def calibrate(_: Any, recording: Any, __: Any) -> Any:
        if recording.name == "image_noise 40":
            raise InputError("ada: cameras see no person")
        return made("cameras")

    def train(_: Any, recording: Any, cameras: Any, masks: Any, body: Any, settings: Any) -> Any:
        trained.append({"recording": recording.name, "masks": masks.name, "body": body.name, "settings": settings})
        if masks.name == "mask_eroded 1":
            raise RuntimeError('rank 0 ended with exit code 1\n  File "run.py"\nValueError: empty')
        stored = {
            "static": recording.name == "frames_left 1",
            "training": {"field": {"kind": settings.field.kind}, "pose_learning_rate": 0},
        }
        return made(f"model of {recording.name}, {body.name}", report={"seconds": 60.0}, settings=stored)

    def evaluate(_: Any, truth: Any, recording: Any, cameras: Any, masks: Any, body: Any, model: Any, __: Any) -> Any:
        assert truth == ("of skirt 0.02" if recording.name == "skirt 0.02" else "true")
        assert body.name == "body"  # novel poses come from the undegraded body, even if training used another
        psnr = 28.0 if "pose_noise 2" in model.name else 30.0
        late = recording.name == "image_noise 5"  # this run has an extra, easy image
        views = {1: psnr + 2, 3: psnr - 2} if not late else {1: 32.0, 4: 99.0}
        images = [{"camera": "c", "frame": f, "psnr": db, "ssim": 0.9, "empty_psnr": 18.0} for f, db in views.items()]
        surfaces = [{"frame": 1, "chamfer_mm": 6.0}, {"frame": 4, "chamfer_mm": 1.0}][: 1 + late]
        scored = images if module.Capture.load(recording.root).test_cameras else []
        split = {"per_image": scored, "geometry": {"per_surface": surfaces}}
        columns = {"novel_pose": split}
        for name, more_db in (("posed", 0.5), ("tracked", 1.0)):
            better = [row | {"psnr": row["psnr"] + more_db} for row in scored]
            columns[f"novel_pose_{name}"] = {"per_image": better}
        view = {"per_image": [images[0] | {"frame": 0, "psnr": 40.0}], "geometry": None}
        return made("report", metrics={"protocol": "By eye.", "novel_view": view} | columns)

    def degrade(*inputs: Any) -> Any:
        return made(f"{inputs[-1].kind} {inputs[-1].strength:g}")

    def degrade_clothing(_: Any, truth: Any, recording: Any, cameras: Any, body: Any, degradation: Any) -> Any:
        assert (truth, recording.name, body.name) == ("true", "capture", "body")
        return degrade(degradation)

    def read_capture(folder: Path, store: Path | None = None) -> tuple[Any, Any]:
        return SimpleNamespace(root=folder, digest=str(folder)), "true" if store else f"of {folder.name}"

    def show(_: Any, __: Any, degradation: Any) -> Any:
        fault = "surface is not watertight" if degradation.strength == 60 else None
        return made("poses", surface={"pose 0": {"fault": None}, "pose 1": {"fault": fault}})

    def chart(*figures: Any) -> bool:
        figures[-1].touch()
        return True

    replaced = {
        "matrix_chart": chart,
        "curve_chart": chart,
        "read_capture": read_capture,
        "ingest": lambda *_: made("capture"),
        "with_detections": lambda store, recording, settings: recording,
        "calibrate": calibrate,
        "segment_subject": lambda *_: made("masks"),
        "fit": lambda *_: made("body"),
        "train": train,
        "evaluate": evaluate,
        "degrade_capture": degrade,
        "degrade_masks": degrade,
        "degrade_fit": degrade,
        "degrade_clothing": degrade_clothing,
        "check_meshes": lambda *_: made("surfaces", surface={"000001": {"fault": None}}),
        "show_in_extreme_poses": show,
    }
    for name, stage in replaced.items():
        for place in (module, preparation):
            if hasattr(place, name):
                monkeypatch.setattr(place, name, stage)
    capture = SimpleNamespace(name="ada", test_cameras=("c",), novel_pose_frames=(1, 3, 4))
    monkeypatch.setattr(module.Capture, "load", lambda _: capture)
    (tmp_path / "mine.yaml").write_text(STUDY)
    return trained


@pytest.fixture
def true_charts(stages: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw the charts, which takes a second."""
    monkeypatch.setattr(module, "matrix_chart", matrix_chart)
    monkeypatch.setattr(module, "curve_chart", curve_chart)


def study(tmp_path: Path, **options: Any) -> dict[str, Any]:
    """Run the study of this file; return its result."""
    table = stability.fn(tmp_path, str(tmp_path / "mine.yaml"), tmp_path / "store", **options)
    part = "-part" if options else ""
    assert table == tmp_path / "store" / "stability" / f"ada-mine{part}.md"
    return json.loads(table.with_suffix(".json").read_text())


@pytest.mark.usefixtures("true_charts")
def test_every_run_has_a_verdict(tmp_path: Path) -> None:
    found = study(tmp_path)
    seen = [(r["kind"], r["strength"], r["verdict"], r["reason"]) for r in found["runs"] if r["seed"] == 1]
    assert seen == [
        ("as recorded", None, "ok", ""),
        ("image_noise", 5, "ok", ""),
        ("image_noise", 40, "refused", "ada: cameras see no person"),
        ("skirt", 0.02, "ok", ""),
        ("mask_eroded", 1, "failed", "ValueError: empty"),
        ("pose_noise", 2, "degraded", "2.0 dB of PSNR lost"),
        ("learning_rate_up", 10, "ok", ""),
        ("extreme_poses", 45, "ok", ""),
        ("extreme_poses", 60, "failed", "surface is not watertight"),
    ]
    assert len(found["runs"]) == 2 * len(seen)
    assert found["protocol"] == "By eye."
    charts = {path.name for path in (tmp_path / "store" / "stability").glob("*.png")}
    assert charts == {"ada-mine-matrix.png", "ada-mine-psnr.png", "ada-mine-chamfer_mm.png"}


def test_a_field_without_a_surface_has_the_verdict_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    evaluate = module.evaluate

    def evaluate_mist(*inputs: Any) -> Any:
        report = evaluate(*inputs)
        path = report.root / "metrics.json"
        metrics = json.loads(path.read_text())
        why = "signed distance field: not finite; training diverged"
        metrics["novel_pose"] |= {"geometry": None, "geometry_reason": why}
        path.write_text(json.dumps(metrics))
        return report

    monkeypatch.setattr(module, "evaluate", evaluate_mist)
    run = study(tmp_path, only=["pose_noise"])["runs"][0]
    assert (run["verdict"], run["reason"]) == ("failed", "signed distance field: not finite; training diverged")


def test_runs_are_compared_on_the_images_and_surfaces_that_both_have(tmp_path: Path) -> None:
    """The noisy run is compared in frame 1 only, where both runs have 32 dB and 6 mm; the good run's mean over its two
    frames is 30 dB."""
    good, noisy = study(tmp_path, only=["image_noise"])["runs"][:2]
    assert (good["psnr"], good["images"], good["chamfer_mm"], good["surfaces"]) == (30.0, 2, 6.0, 1)
    assert (noisy["psnr"], noisy["images"], noisy["chamfer_mm"], noisy["surfaces"]) == (32.0, 1, 6.0, 1)
    assert (noisy["reference"]["psnr"], noisy["reference"]["images"]) == (32.0, 1)
    assert (noisy["posed_psnr"], noisy["tracked_psnr"], noisy["reference"]["tracked_psnr"]) == (32.5, 33.0, 33.0)
    table = (tmp_path / "store" / "stability" / "ada-mine-part.md").read_text()
    assert "| ok | 32.00 (+0.00) | 32.50 (+0.00) | 33.00 (+0.00) | 0.900 (+0.000) | 6.00 (+0.00) |" in table


@pytest.mark.usefixtures("true_charts")
def test_the_page_of_the_flow_run_embeds_the_charts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    monkeypatch.setattr(run_page, "FlowRunContext", Mock())
    monkeypatch.setattr(run_page, "create_markdown_artifact", lambda text, **_: shown.append(text))
    study(tmp_path, only=["pose_noise"])
    chart = (tmp_path / "store" / "stability" / "ada-mine-part-matrix.png").read_bytes()
    (text,) = shown
    assert f"![ada-mine-part-matrix.png](data:image/png;base64,{base64.b64encode(chart).decode()})" in text
    assert ".png)" not in text


def test_a_degradation_that_does_not_apply_is_left_out_without_a_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "degrade_masks", Mock(side_effect=NotApplicableError("ada: has no keypoints")))
    found = study(tmp_path, only=["mask_eroded"])
    assert [run["kind"] for run in found["runs"]] == ["as recorded", "as recorded"]
    assert found["left_out"].count("masks eroded, % of image width, 1: ada: has no keypoints") == 1


def test_without_test_cameras_images_are_not_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = SimpleNamespace(name="ada", test_cameras=(), novel_pose_frames=(1, 3))
    monkeypatch.setattr(module.Capture, "load", lambda _: capture)
    runs = study(tmp_path, only=["pose_noise"])["runs"]
    assert [(run["psnr"], run["chamfer_mm"], run["verdict"]) for run in runs[:2]] == [(None, 6.0, "ok")] * 2


def test_each_degradation_changes_the_input_of_its_own_stage(stages: list[dict[str, Any]], tmp_path: Path) -> None:
    study(tmp_path)
    inputs = [(s["recording"], s["masks"], s["body"]) for s in stages if s["settings"].seed == 0]
    good = ("capture", "masks", "body")
    assert inputs == [
        good,
        ("image_noise 5", "masks", "body"),
        ("skirt 0.02", "masks", "body"),
        ("capture", "mask_eroded 1", "body"),
        ("capture", "masks", "pose_noise 2"),
        good,  # learning rate
        good,  # extreme poses; the real store already has this training
        good,
    ]
    rates = [s["settings"].field.network_learning_rate for s in stages if s["settings"].seed == 0]
    assert rates == pytest.approx([0.01, 0.01, 0.01, 0.01, 0.01, 0.1, 0.01, 0.01])


def test_a_method_that_refuses_the_capture_is_tried_once_per_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "train", Mock(side_effect=InputError("NeRF models one moment; choose one frame")))
    runs = study(tmp_path)["runs"]
    assert [(r["kind"], r["verdict"]) for r in runs] == [("as recorded", "refused")] * 2
    assert "NeRF models one moment" in runs[0]["reason"]


def test_border_seeds_repeat_only_runs_near_a_border(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = STUDY.replace("seeds: [0, 1]", "seeds: [0]\nborder_seeds: [3, 4]")
    (tmp_path / "mine.yaml").write_text(text)
    runs = study(tmp_path, only=["pose_noise", "image_noise"])["runs"]  # 2 dB is not near a border
    assert {run["seed"] for run in runs} == {0}
    monkeypatch.setattr("hnerf.study.stability.verdict.DEGRADED_DB", 2.2)
    runs = study(tmp_path, only=["pose_noise", "image_noise"])["runs"]
    assert [(run["seed"], run["kind"]) for run in runs if run["seed"]] == [
        (3, "as recorded"),
        (3, "pose_noise"),
        (4, "as recorded"),
        (4, "pose_noise"),
    ]


def test_a_study_of_a_part_uses_only_that_part_of_the_capture(
    stages: list[dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = module.Capture.load(tmp_path)
    whole.train_frames = (2, 5)
    whole.train_cameras = ("a", "b")

    def subset_capture(_: Any, recording: Any, *parts: Any) -> Any:
        assert (recording.name, parts) == ("capture", (None, (2,), ()))
        return SimpleNamespace(root=tmp_path, name="moment")

    monkeypatch.setattr(preparation, "subset_capture", subset_capture)
    part = "part: {frames: 1, novel_poses: false}"
    (tmp_path / "mine.yaml").write_text(STUDY.replace("seeds: [0, 1]", f"seeds: [0]\n{part}"))
    found = study(tmp_path, only=["pose_noise"])
    assert [(s["recording"], s["body"]) for s in stages] == [("moment", "body"), ("moment", "pose_noise 2")]
    assert "the capture outside this part: frames 1, novel_poses False" in found["left_out"]


def test_bad_input_in_evaluation_has_the_verdict_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "evaluate", Mock(side_effect=InputError("no surface in its box")))
    assert {r["verdict"] for r in study(tmp_path, only=["pose_noise"])["runs"]} == {"failed"}


@pytest.mark.parametrize(
    "error",
    [
        LostWorkerError("rank 0 was killed"),
        OSError(28, "No space left on device"),
        PlaceError("s3://b: closed"),
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB."),
    ],
)
def test_errors_of_the_machine_end_the_command_and_finished_runs_are_kept(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "degrade_fit", Mock(side_effect=error))
    with pytest.raises(type(error)):
        study(tmp_path)
    table = tmp_path / "store" / "stability" / "ada-mine.md"
    found = json.loads(table.with_suffix(".json").read_text())
    assert [r["kind"] for r in found["runs"]] == ["as recorded", "image_noise", "image_noise", "skirt", "mask_eroded"]
    assert "![ada-mine-matrix.png]" in table.read_text()


def test_an_interruption_of_the_first_run_leaves_an_earlier_study_unchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    earlier = study(tmp_path, only=["pose_noise"])
    monkeypatch.setattr(module, "train", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        study(tmp_path, only=["pose_noise"])
    folder = tmp_path / "store" / "stability"
    assert json.loads((folder / "ada-mine-part.json").read_text()) == earlier
    assert "degraded at 2" in (folder / "ada-mine-part.md").read_text()


def test_the_table_of_another_capture_with_the_same_name_is_kept(tmp_path: Path) -> None:
    earlier = study(tmp_path, only=["pose_noise"])
    with pytest.raises(InputError, match=f"ada-mine-part.md: is of {tmp_path}, not of {tmp_path}/other; give one"):
        stability.fn(tmp_path / "other", str(tmp_path / "mine.yaml"), tmp_path / "store", only=["skirt"])
    assert json.loads((tmp_path / "store" / "stability" / "ada-mine-part.json").read_text()) == earlier


def test_an_error_of_a_chart_does_not_hide_the_error_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "degrade_fit", Mock(side_effect=LostWorkerError("rank 0 was killed")))
    monkeypatch.setattr(module, "matrix_chart", Mock(side_effect=ValueError("no ink")))
    with pytest.raises(LostWorkerError):
        study(tmp_path, only=["pose_noise"])


def test_running_a_part_leaves_the_files_of_the_whole_study_unchanged(tmp_path: Path) -> None:
    study(tmp_path)
    files = {path: path.read_bytes() for path in (tmp_path / "store" / "stability").iterdir()}
    for part in ({"only": ["pose_noise"]}, {"methods": ["demo"]}):
        study(tmp_path, **part)
        assert {path: path.read_bytes() for path in files} == files


@pytest.mark.usefixtures("true_charts")
def test_outdated_charts_of_an_earlier_call_are_removed(tmp_path: Path) -> None:
    """The second call has only extreme poses, which are judged by surfaces and have no curves."""
    study(tmp_path, only=["pose_noise"])
    study(tmp_path, only=["extreme_poses"])
    charts = {path.name for path in (tmp_path / "store" / "stability").glob("*.png")}
    assert charts == {"ada-mine-part-matrix.png"}


def test_a_failed_reference_run_is_kept_and_ends_its_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "surface.json").write_text(json.dumps({"000001": {"fault": "surface is not watertight"}}))
    monkeypatch.setattr(module, "check_meshes", lambda *_: SimpleNamespace(root=tmp_path))
    table = study(tmp_path, only=["pose_noise"])
    rows = [(r["kind"], r["seed"], r["verdict"], r["reason"]) for r in table["runs"]]
    assert rows == [("as recorded", seed, "failed", "surface is not watertight") for seed in (0, 1)]
    text = (tmp_path / "store" / "stability" / "ada-mine-part.md").read_text()
    assert "| pose noise, ° a joint | failed at 2 |" in text


def test_methods_without_novel_poses_are_judged_on_novel_views(tmp_path: Path) -> None:
    """Nerfies has no novel poses at all. The published method has none with one frame, so nothing to compare with its
    other runs."""
    (tmp_path / "mine.yaml").write_text(
        "methods: [nerfies, paper]\nseeds: [0]\ndegradations: {frames_left: [2, 1], extreme_poses: [45]}"
    )
    found = study(tmp_path)
    rows = [(r["method"], r["kind"], r["strength"], r["verdict"], r.get("psnr")) for r in found["runs"]]
    assert rows == [
        ("nerfies", "as recorded", None, "ok", 40.0),
        ("nerfies", "frames_left", 2, "ok", 40.0),
        ("nerfies", "frames_left", 1, "ok", 40.0),
        ("paper", "as recorded", None, "ok", 30.0),
        ("paper", "frames_left", 2, "ok", 30.0),
        ("paper", "frames_left", 1, "unscored", None),
        ("paper", "extreme_poses", 45, "ok", None),
    ]
    assert any("Nerfies has no pose to set" in reason for reason in found["left_out"])


def test_the_command_prints_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--study", str(tmp_path / "mine.yaml"), "--store", str(tmp_path / "store"), "--only", "pose_noise"]
    assert main(["stability", str(tmp_path), "--methods", "fast, paper", *options]) == 0
    shown = capsys.readouterr().out
    assert "| pose noise, ° a joint | degraded at 2 | degraded at 2 |" in shown
    assert f"table: {tmp_path / 'store' / 'stability' / 'ada-mine-part.md'}" in shown


def test_a_method_that_is_named_twice_is_run_once(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("methods: [fast]\nseeds: [0]\ndegradations: {skirt: [0.02]}")
    table = stability.fn(tmp_path, str(tmp_path / "mine.yaml"), tmp_path / "store", ["fast", "fast"])
    assert table.name == "ada-mine.md"  # as in the study: not a part of it
    assert "| degradation | fast |\n" in table.read_text()


def test_unknown_names_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stability", str(tmp_path), "--quick", "--only", "hats"]) == 2
    assert "--only hats: not in this study" in capsys.readouterr().err
    assert main(["stability", str(tmp_path), "--quick", "--methods", "best"]) == 2
    assert "best: no such preset or file" in capsys.readouterr().err

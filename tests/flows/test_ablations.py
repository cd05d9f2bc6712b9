"""The choice of ablations, and the table of made-up scores."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from flows import ablations as module
from flows import preparation, run_page
from flows.ablations import ablate, as_markdown, choose
from flows.cli import main
from hnerf.config import LossSettings, TrainingSettings, load_settings
from hnerf.errors import InputError
from hnerf.evaluation.images import unscored
from hnerf.study.benchmark import results
from tasks.launcher import LostWorkerError

SPLIT = {
    "psnr": 30.126,
    "ssim": 0.9,
    "mask_iou": 0.95,
    "lpips": 0.04,
    "geometry": {"chamfer_l2_e3": 0.05, "normal_consistency": 0.94, "iou": 0.875},
}


@pytest.fixture
def stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[TrainingSettings]:
    """Replace every stage by a fake; return the list that collects the training settings of each row. Training fails
    without noise, and loses its worker without the eikonal loss. The PSNR in dB equals the weight of the
    reconstruction loss; with poses as fitted, evaluation finds no surface."""
    trained: list[TrainingSettings] = []

    def train(*inputs: Any) -> Any:
        settings = inputs[-1]
        trained.append(settings)
        if settings.noise == 0:
            raise RuntimeError('rank 0 ended with exit code 1\n  File "run.py"\nTrainingError: the surface is empty')
        if settings.losses.eikonal == 0:
            raise LostWorkerError("rank 0 was killed by SIGKILL")
        (tmp_path / "report.json").write_text('{"seconds": 61.7, "device": "abacus", "steps": 3}')
        stored = {"static": True, "training": {"field": {"kind": settings.field.kind}, "pose_learning_rate": 0}}
        (tmp_path / "settings.json").write_text(json.dumps(stored))
        return SimpleNamespace(root=tmp_path)

    def evaluate(*inputs: Any) -> Any:
        if trained[-1].pose_learning_rate == 0:
            raise InputError("signed distance field: no surface in its box")
        split = SPLIT | {"psnr": trained[-1].losses.reconstruction}
        reason = "H-NeRF's static network models one moment"
        poses = split if trained[-1].field.kind == "fast" else unscored(reason) | {"geometry": None}
        metrics = {"protocol": "By eye.", "novel_view": split, "seconds": 5.0, "holdout": None}
        metrics |= dict.fromkeys(("novel_pose", "novel_pose_posed", "novel_pose_tracked"), poses)
        (tmp_path / "metrics.json").write_text(json.dumps(metrics))
        return SimpleNamespace(root=tmp_path)

    for name in ("calibrate", "segment_subject", "fit"):
        monkeypatch.setattr(preparation, name, lambda *_: None)
    monkeypatch.setattr(preparation, "ingest", lambda *_: SimpleNamespace(root=tmp_path))
    monkeypatch.setattr(module, "with_detections", lambda store, recording, settings: recording)
    monkeypatch.setattr(
        module, "read_capture", lambda folder, _: (SimpleNamespace(root=folder, digest=str(folder)), None)
    )
    monkeypatch.setattr(module.Capture, "load", lambda _: SimpleNamespace(name="ada"))
    monkeypatch.setattr(module, "train", train)
    monkeypatch.setattr(module, "evaluate", evaluate)
    return trained


def test_the_paper_preset_has_a_row_for_each_of_its_losses_and_switches() -> None:
    rows, left_out = choose(load_settings("paper"), [])
    losses = {f"no-{name}" for name, weight in LossSettings() if weight}  # others are not part of the published method
    others = {"no-eta", "no-density_threshold", "no-density_steepness", "no-geometry_roles"}
    assert next(iter(rows)) == "full"
    assert set(rows) == {"full", "no-opt", "no-root", "no-noise"} | losses - others
    assert left_out == {"no-deformation": "the paper field has no such part"}


def test_rows_differ_from_the_preset_in_one_setting() -> None:
    full = load_settings("paper")
    rows, _ = choose(full, [])
    before = _leaves(full.model_dump())
    after = {name: dict(_leaves(row.model_dump()).items() - before.items()) for name, row in rows.items()}
    assert after.pop("full") == {}
    assert after.pop("no-opt") == {"training.pose_learning_rate": 0}
    assert after.pop("no-root") == {"training.field.root_condition": False}
    assert after.pop("no-noise") == {"training.noise": 0}
    assert after == {f"no-{name}": {f"training.losses.{name}": 0} for name in (row[3:] for row in after)}


def _leaves(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in tree.items():
        found |= _leaves(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return found


def test_ablations_of_unused_parts_are_left_out() -> None:
    rows, left_out = choose(load_settings("fast"), [])
    off = [f"no-{name}" for name in ("blend", "fit", "geometry", "increment", "mask", "residual", "segmentation")]
    assert left_out == dict.fromkeys(off, "off already") | {"no-root": "the fast field has no such part"}
    assert list(rows) == ["full", "no-deformation", "no-eikonal", "no-noise", "no-opt", "no-reconstruction"]


@pytest.mark.parametrize("preset", ["nerf", "idr", "neural-body", "nerfies"])
def test_parts_of_h_nerf_are_left_out_of_other_methods(preset: str) -> None:
    _, left_out = choose(load_settings(preset), ["no-root", "no-deformation"])
    kind = preset.replace("-", "_")
    assert left_out == dict.fromkeys(["no-root", "no-deformation"], f"the {kind} field has no such part")


def test_overrides_apply_to_every_row_before_its_ablation() -> None:
    rows, left_out = choose(load_settings("fast", ["training.losses.mask=0.5", "training.steps=7"]), ["no-mask"])
    assert left_out == {}
    assert [row.training.losses.mask for row in rows.values()] == [0.5, 0.0]
    assert [row.training.steps for row in rows.values()] == [7, 7]


def test_unknown_names_are_refused() -> None:
    with pytest.raises(
        InputError, match="--only no-hair: no such ablation; there are no-blend, no-deformation, no-eikonal"
    ):
        choose(load_settings("fast"), ["no-hair"])


def test_a_row_that_names_a_missing_file_is_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own-masks.yaml").write_text("segmentation: {model: absent.onnx}")
    monkeypatch.setattr(module, "ABLATIONS", tmp_path)
    with pytest.raises(InputError, match=r"^segmentation\.model: absent\.onnx: no such file"):
        choose(load_settings("fast"), [])


def test_the_table_equals_one_written_by_hand() -> None:
    bare = {"psnr": None, "ssim": None, "mask_iou": None, "geometry": None}
    full = {"novel_view": SPLIT, "novel_pose": SPLIT, "novel_pose_posed": bare, "novel_pose_tracked": SPLIT}
    result = {
        "subject": "ada",
        "preset": "fast",
        "overrides": ["training.steps=7"],
        "rows": {
            "full": full | {"seconds": 61.7, "device": "abacus", "protocol": "Eye."},
            "no-opt": {"error": "a | b"},
        },
        "left_out": {"no-mask": "off already"},
    }
    assert as_markdown(result).splitlines() == [
        "# Ablations of ada, preset `fast` with training.steps=7",
        "",
        results.CELL_LEGEND,
        "",
        "|  | PSNR | SSIM | mask IoU | LPIPS | Chamfer x1e-3 m² | NC | IoU | training, s | on |",
        "|---|---|---|---|---|---|---|---|---|---|",
        "| full | 30.13 / 30.13 / - / 30.13 | 0.900 / 0.900 / - / 0.900 | 0.950 / 0.950 / - / 0.950 "
        "| 0.040 / 0.040 / - / 0.040 | 0.050 / 0.050 | 0.940 / 0.940 | 0.875 / 0.875 | 62 | abacus |",
        "| no-opt | a / b |  |  |  |  |  |  |  |  |",
        "",
        "Left out:",
        "",
        "- no-mask: off already",
        "",
        "Eye.",
    ]


def test_a_failed_row_holds_its_error_and_the_other_rows_are_computed(
    stages: list[TrainingSettings], tmp_path: Path
) -> None:
    table = ablate.fn(tmp_path, "fast", tmp_path / "store", [], ["no-noise", "no-opt", "no-reconstruction"])
    assert table == tmp_path / "store" / "ablations" / "ada-fast-part.md"
    result = json.loads(table.with_suffix(".json").read_text())
    rows = result["rows"]
    assert list(rows) == ["full", "no-noise", "no-opt", "no-reconstruction"]
    assert rows["no-noise"] == {"error": "TrainingError: the surface is empty"}
    assert rows["no-opt"] == {"error": "signed distance field: no surface in its box"}
    assert [rows[name]["novel_view"]["psnr"] for name in ("full", "no-reconstruction")] == [1.0, 0.0]
    assert rows["full"]["seconds"] == 61.7
    assert table.read_text() == as_markdown(result)


def test_the_table_of_another_capture_with_the_same_name_is_kept(
    stages: list[TrainingSettings], tmp_path: Path
) -> None:
    table = ablate.fn(tmp_path / "ada", "fast", tmp_path / "store", [], ["no-reconstruction"])
    before, trained = table.read_text(), len(stages)
    with pytest.raises(InputError, match=f"ada-fast-part.md: is of {tmp_path}/ada, not of {tmp_path}/other"):
        ablate.fn(tmp_path / "other", "fast", tmp_path / "store", [], ["no-opt"])
    assert table.read_text() == before and len(stages) == trained


def test_a_method_without_novel_poses_has_no_scores_for_them(stages: list[TrainingSettings], tmp_path: Path) -> None:
    """The published method, trained on one frame."""
    table = ablate.fn(tmp_path, "paper", tmp_path / "store", [], ["no-reconstruction"])
    rows = json.loads(table.with_suffix(".json").read_text())["rows"]
    assert rows["full"]["novel_pose"]["reason"] == "H-NeRF's static network models one moment"
    assert "| full | 1.00 / - / - / - |" in table.read_text()
    expected = "no images of animated new poses: H-NeRF's static network models one moment"
    assert table.read_text().count("H-NeRF's static network") == table.read_text().count(f"- {expected}\n") == 1


def test_the_page_of_the_flow_run_shows_the_table(
    stages: list[TrainingSettings], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[str] = []
    monkeypatch.setattr(run_page, "FlowRunContext", Mock())
    monkeypatch.setattr(run_page, "create_markdown_artifact", lambda text, **_: shown.append(text))
    table = ablate.fn(tmp_path, store=tmp_path / "store", only=["no-opt"])
    assert shown == [table.read_text()]


def test_a_lost_worker_ends_the_command_and_finished_rows_are_kept(
    stages: list[TrainingSettings], tmp_path: Path
) -> None:
    with pytest.raises(LostWorkerError):
        ablate.fn(tmp_path, "fast", tmp_path / "store", [], ["no-opt", "no-eikonal", "no-reconstruction"])
    result = json.loads((tmp_path / "store" / "ablations" / "ada-fast-part.json").read_text())
    assert list(result["rows"]) == ["full", "no-opt"]
    assert len(stages) == 3


def test_the_command_prints_the_table(
    stages: list[TrainingSettings], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--store", str(tmp_path / "store"), "--set", "training.losses.reconstruction=12", "--only", "no-mask"]
    assert main(["ablate", str(tmp_path), *options]) == 0
    shown = capsys.readouterr().out
    assert "| full | 12.00 / 12.00 / 12.00 / 12.00 |" in shown
    assert "- no-mask: off already" in shown
    assert f"table: {tmp_path / 'store' / 'ablations' / 'ada-fast-part.md'}" in shown

"""The benchmark flow with fake stages, and the caching of its scoring stage in the store."""

import base64
import json
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from flows import benchmark as module
from flows import preparation, run_page
from flows.benchmark import benchmark
from flows.cli import main
from hnerf.config import TrainingSettings
from hnerf.errors import InputError
from hnerf.files import embed_images, markdown_image
from hnerf.study.benchmark import publish as publish_module
from hnerf.study.benchmark.plan import ScoringSettings
from tasks import benchmark as tasks_module
from tasks.launcher import LostWorkerError
from tasks.limits import current_limits
from tasks.source import Source, read_capture
from tasks.store import Artifact, Store
from tests.study.benchmark.test_results import scores

RECORDED = SimpleNamespace(
    name="ada",
    train_cameras=("1", "2", "3", "4"),
    test_cameras=("5",),
    train_frames=(0, 1, 2),
    frames=(0, 1, 2),
    recorded_frame=lambda _, frame: frame,
    has_given_mask=lambda *_: False,
)
STUDY = """
title: Toys
seconds: 60
snapshots: 2
methods: [fast, demo, paper]
variants:
  all: {methods: [fast, demo]}
  one frame: {frames: 1, novel_poses: false}
  many: {cameras: 8}
"""


PSNR = {"fast": 30.0, "paper": 20.0}


class Stages(list[tuple[str, TrainingSettings]]):
    """The recording and settings of each requested training; `fails`: the error that a kind of field raises."""

    fails: dict[str, Exception]


@pytest.fixture
def stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Stages:
    """Replace every stage by a fake; return the list of requested trainings."""
    asked = Stages()
    asked.fails = {}

    def train(store: Any, recording: Any, *others: Any) -> Any:
        settings = others[-1]
        asked.append((recording.title, settings))
        if settings.field.kind in asked.fails:
            raise asked.fails[settings.field.kind]
        return SimpleNamespace(kind=settings.field.kind)

    def score_training(store: Any, truth: Any, recording: Any, calibration: Any, body: Any, model: Any, _: Any) -> Any:
        assert body == "body"
        folder = store.root / "scoring" / model.kind
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "scores.json").write_text(json.dumps(scores(PSNR[model.kind], 1.0, "") | {"pictures": []}))
        return SimpleNamespace(root=folder)

    for name in ("calibrate", "segment_subject"):
        monkeypatch.setattr(preparation, name, lambda *_: None)
    monkeypatch.setattr(preparation, "fit", lambda *_: "body")
    monkeypatch.setattr(preparation, "ingest", lambda *_: SimpleNamespace(root=tmp_path, title="whole"))
    monkeypatch.setattr(preparation, "with_detections", lambda store, recording, settings: recording)
    monkeypatch.setattr(preparation, "subset_capture", lambda _, recording, *parts: SimpleNamespace(title=str(parts)))
    truth = SimpleNamespace(root=tmp_path)
    monkeypatch.setattr(
        module, "read_capture", lambda folder, _: (SimpleNamespace(root=folder, digest=str(folder)), truth)
    )
    true_mask(tmp_path).parent.mkdir(parents=True)
    true_mask(tmp_path).touch()
    monkeypatch.setattr(module, "calibrated_capture", lambda *_: RECORDED)
    monkeypatch.setattr(module.Capture, "load", lambda _: RECORDED)
    monkeypatch.setattr(module, "train", train)
    monkeypatch.setattr(module, "score_training", score_training)
    return asked


@pytest.fixture
def without_charts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw no charts, which take a second each time."""
    monkeypatch.setattr(publish_module, "draw_charts", lambda *_: [])


@pytest.fixture
def study(tmp_path: Path) -> str:
    (tmp_path / "toys.yaml").write_text(STUDY)
    return str(tmp_path / "toys.yaml")


def true_mask(folder: Path) -> Path:
    """Return the path of the test camera's only true mask."""
    return folder / "ground_truth" / "masks" / "5" / "000000.png"


def read(table: Path) -> dict[str, Any]:
    return json.loads(table.with_suffix(".json").read_text())


@pytest.mark.usefixtures("without_charts")
def test_every_method_of_every_variant_is_trained_for_the_same_time(stages: Stages, study: str, tmp_path: Path) -> None:
    table = benchmark.fn(tmp_path, study, store=tmp_path / "store")
    one = str((None, (0,), ()))
    assert [title for title, _ in stages] == ["whole", "whole", one, one, one]
    assert [settings.field.kind for _, settings in stages] == ["fast", "fast", "fast", "fast", "paper"]
    assert {(settings.seconds, settings.snapshots_s) for _, settings in stages} == {(60.0, (15.0, 30.0))}
    assert table == tmp_path / "store" / "benchmark" / "ada-toys.md"
    variants = read(table)["variants"]
    assert list(variants["all"]["methods"]) == ["fast", "demo"]
    assert (variants["one frame"]["cameras"], variants["one frame"]["frames"]) == (4, 1)
    assert variants["many"] == {"left_out": "the capture has 4 training cameras, not 8"}
    assert variants["all"]["methods"]["fast"]["folder"] == "scoring/fast"
    assert variants["all"]["methods"]["demo"]["novel_view"]["psnr"] == 30.0


@pytest.mark.usefixtures("without_charts")
def test_trainings_get_longer_until_their_curve_is_flat_or_time_or_steps_end(
    stages: Stages, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`fast` has steps for 30 s only. `nerf` has no surface yet at 10 s, and its curve is flat at 640 s."""
    psnr = {20.0: 18.0, 40.0: 18.0, 80.0: 20.0, 160.0: 24.0, 320.0: 25.0, 640.0: 25.05}

    def score_end(*inputs: Any) -> Any:
        name, training = stages[-1][1].field.kind, stages[-1][1]
        seconds = min(training.seconds, 30.0) if name == "fast" else training.seconds
        point = {"n": 1, "seconds": seconds, "psnr": 30.0 if name == "fast" else psnr[seconds]}
        (tmp_path / "scores.json").write_text(json.dumps({"training": {"field_seconds": seconds}, "curve": [point]}))
        return SimpleNamespace(root=tmp_path)

    def train(store: Any, recording: Any, *others: Any) -> Any:
        if others[-1].field.kind == "nerf" and others[-1].seconds == 10.0:
            raise InputError("the surface is empty")
        return good(store, recording, *others)

    good = module.train
    monkeypatch.setattr(module, "train", train)
    monkeypatch.setattr(module, "score_end_of_training", score_end)
    monkeypatch.setitem(PSNR, "nerf", 25.05)
    text = "title: t\nmethods: [fast, nerf]\nvariants: {one: {}}\nuntil_flat: true\nsnapshots: 0\nseconds: "
    (tmp_path / "mine.yaml").write_text(f"{text}10800")
    found = read(benchmark.fn(tmp_path, str(tmp_path / "mine.yaml"), store=tmp_path / "store"))
    fast, nerf = found["variants"]["one"]["methods"].values()
    assert (fast["ended"], [row["seconds"] for row in fast["curve"]]) == ("steps", [10.0, 20.0, 30.0])
    assert (nerf["ended"], [row["seconds"] for row in nerf["curve"]]) == ("flat", list(psnr))
    assert [training.seconds for _, training in stages][-2:] == [640.0, 640.0]  # the second is found in the store
    assert nerf["novel_view"]["psnr"] == 25.05
    true_mask(tmp_path).unlink()
    monkeypatch.setattr(RECORDED, "has_given_mask", lambda *_: True)  # the recording's masks suffice
    (tmp_path / "mine.yaml").write_text(f"{text}100")
    found = read(benchmark.fn(tmp_path, str(tmp_path / "mine.yaml"), store=tmp_path / "store"))
    assert found["variants"]["one"]["methods"]["nerf"]["ended"] == "limit"


@pytest.mark.usefixtures("without_charts")
def test_a_method_that_always_fails_is_trained_once_per_duration(stages: Stages, tmp_path: Path) -> None:
    text = "title: t\nmethods: [fast]\nvariants: {one: {}}\nuntil_flat: true\nsnapshots: 0\nseconds: 40"
    (tmp_path / "mine.yaml").write_text(text)
    stages.fails["fast"] = InputError("the surface is empty")
    found = read(benchmark.fn(tmp_path, str(tmp_path / "mine.yaml"), store=tmp_path / "store"))
    assert found["variants"]["one"]["methods"]["fast"] == {"error": "the surface is empty"}
    assert [training.seconds for _, training in stages] == [10.0, 20.0, 40.0]


def test_the_recording_is_read_within_the_limits_of_the_preset(
    stages: Stages, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "large.yaml").write_text("based_on: fast\nlimits: {reader_gib: 64}")
    text = f"title: t\nmethods: [{tmp_path / 'large.yaml'}]\nvariants: {{one: {{}}}}"
    (tmp_path / "mine.yaml").write_text(text)
    monkeypatch.setattr(preparation, "ingest", lambda *_: pytest.fail(f"{current_limits().reader_gib:g} GiB"))
    with pytest.raises(pytest.fail.Exception, match=r"^64 GiB"):
        benchmark.fn(tmp_path, str(tmp_path / "mine.yaml"), store=tmp_path / "store")


@pytest.mark.parametrize("lacks", ["test cameras", "masks"])
def test_until_flat_is_refused_if_no_image_can_be_scored(
    stages: Stages, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lacks: str
) -> None:
    if lacks == "masks":
        true_mask(tmp_path).unlink()
    else:
        monkeypatch.setattr(RECORDED, "test_cameras", ())
    with pytest.raises(InputError, match="ada: no image can be scored, so no curve can become flat; add test cameras"):
        benchmark.fn(tmp_path, "static-converged", store=tmp_path / "store")
    assert stages == []


@pytest.mark.usefixtures("without_charts")
@pytest.mark.parametrize(
    "error", [RuntimeError('rank 0\n  File "run.py"\nthe surface is empty'), InputError("the surface is empty")]
)
def test_a_failed_method_holds_its_error_and_the_others_are_trained(
    stages: Stages, study: str, tmp_path: Path, error: Exception
) -> None:
    stages.fails["fast"] = error
    methods = read(benchmark.fn(tmp_path, study, store=tmp_path / "store"))["variants"]["one frame"]["methods"]
    assert methods["fast"] == {"error": "the surface is empty"}
    assert methods["paper"]["novel_view"]["psnr"] == 20.0


@pytest.mark.usefixtures("without_charts")
@pytest.mark.parametrize(("place", "stage"), [(preparation, "subset_capture"), (module, "score_training")])
def test_a_failure_in_subset_or_scoring_affects_one_method_only(
    stages: Stages, study: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: ModuleType, stage: str
) -> None:
    good = getattr(place, stage)

    def broken(*inputs: Any) -> Any:
        if stages[-1][1].field.kind == "fast":
            raise ValueError("the surface is empty")
        return good(*inputs)

    monkeypatch.setattr(place, stage, broken)
    variants = read(benchmark.fn(tmp_path, study, store=tmp_path / "store"))["variants"]
    assert variants["one frame"]["methods"]["fast"] == {"error": "the surface is empty"}


@pytest.mark.usefixtures("without_charts")
def test_a_variant_with_an_unknown_camera_is_left_out_before_training(stages: Stages, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("title: t\nmethods: [fast]\nvariants: {two: {cameras: ['1', '9']}}")
    found = read(benchmark.fn(tmp_path, str(tmp_path / "mine.yaml"), store=tmp_path / "store"))["variants"]
    assert found["two"] == {"left_out": "ada: no training camera 9; there are 1, 2, 3, 4"}
    assert stages == []


@pytest.mark.usefixtures("without_charts")
def test_a_lost_worker_ends_the_flow_and_finished_methods_are_kept(stages: Stages, study: str, tmp_path: Path) -> None:
    stages.fails["paper"] = LostWorkerError("rank 0 was killed by SIGKILL")
    with pytest.raises(LostWorkerError):
        benchmark.fn(tmp_path, study, store=tmp_path / "store")
    variants = read(tmp_path / "store" / "benchmark" / "ada-toys.md")["variants"]
    assert list(variants["one frame"]["methods"]) == ["fast", "demo"]


def test_the_command_prints_table_and_chart(
    stages: Stages, study: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--study", study, "--methods", " demo", "--seconds", "8", "--store", str(tmp_path / "store")]
    assert main(["benchmark", str(tmp_path), *options]) == 0
    assert [settings.snapshots_s for _, settings in stages] == [(2.0, 4.0)] * 2
    shown = capsys.readouterr().out
    assert "| demo | 30.00 / - / - / - |" in shown
    chart = tmp_path / "store" / "benchmark" / "ada-toys-part.png"
    assert f"chart: {chart}" in shown and chart.exists()


@pytest.mark.usefixtures("stages", "without_charts")
@pytest.mark.parametrize(
    ("methods", "seconds", "name"),
    [
        (["fast"], None, "ada-toys-part.md"),
        ([], 8.0, "ada-toys-part.md"),
        (["demo", "paper", "fast"], 60.0, "ada-toys.md"),
    ],
)
def test_a_part_of_a_study_does_not_replace_its_table(
    study: str, tmp_path: Path, methods: list[str], seconds: float | None, name: str
) -> None:
    table = benchmark.fn(tmp_path, study, methods, seconds, tmp_path / "store")
    assert table.name == name
    assert json.loads(table.with_suffix(".json").read_text())["study"] == "toys"  # as in the caption


@pytest.mark.usefixtures("without_charts")
def test_the_table_of_another_capture_with_the_same_name_is_kept(stages: Stages, study: str, tmp_path: Path) -> None:
    benchmark.fn(tmp_path / "ada", study, ["demo"], store=tmp_path / "store")
    trained = len(stages)
    with pytest.raises(InputError, match=f"ada-toys-part.md: is of {tmp_path}/ada, not of {tmp_path}/other"):
        benchmark.fn(tmp_path / "other", study, ["fast"], store=tmp_path / "store")
    assert len(stages) == trained


@pytest.mark.usefixtures("without_charts")
def test_quick_is_a_study(stages: Stages, tmp_path: Path) -> None:
    assert main(["benchmark", str(tmp_path), "--quick", "--methods", "fast", "--store", str(tmp_path / "store")]) == 0
    assert (tmp_path / "store" / "benchmark" / "ada-quick-part.md").exists()
    with pytest.raises(SystemExit):
        main(["benchmark", str(tmp_path), "--quick", "--study", "static"])


def test_the_error_of_an_unknown_method_is_one_line(
    stages: Stages, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["benchmark", str(tmp_path), "--methods", "fats", "--store", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("hnerf: fats: no such preset or file")
    assert stages == []


@pytest.mark.usefixtures("stages")
def test_the_page_of_the_flow_run_embeds_the_charts(
    study: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[str] = []
    monkeypatch.setattr(run_page, "FlowRunContext", Mock())
    monkeypatch.setattr(run_page, "create_markdown_artifact", lambda text, **_: shown.append(text))
    table = benchmark.fn(tmp_path, study, ["demo"], store=tmp_path / "store")
    chart = base64.b64encode(table.with_suffix(".png").read_bytes()).decode()
    (text,) = shown
    assert f"![ada-toys-part.png](data:image/png;base64,{chart})" in text


def test_charts_of_captures_with_unusual_names_are_embedded(tmp_path: Path) -> None:
    (tmp_path / "Ada (2) b-toys.png").write_bytes(b"chart")
    (tmp_path / "Ada (2) b-toys.md").write_text(f"# Toys\n\n{markdown_image('Ada (2) b-toys.png')}\n")
    shown = embed_images(tmp_path / "Ada (2) b-toys.md")
    assert shown == "# Toys\n\n![Ada (2) b-toys.png](data:image/png;base64,Y2hhcnQ=)\n"


def test_scores_are_reused_until_the_inputs_or_settings_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counted: list[Path] = []

    def score(scene: Any, training: Path, settings: ScoringSettings, out: Path) -> dict[str, Any]:
        counted.append(training)
        return scores(30.0, 1.0, "")

    monkeypatch.setattr(tasks_module, "score", score)
    monkeypatch.setattr(tasks_module, "score_end", lambda *_: {"training": {"steps": 1, "field_seconds": 1.0}})
    monkeypatch.setattr(tasks_module, "scoring_scene", lambda *_: None)
    mesh = tmp_path / "ada" / "ground_truth" / "mesh.ply"
    mesh.parent.mkdir(parents=True)
    mesh.write_text("true")
    truth = read_capture(tmp_path / "ada")[1]
    recording, calibration, body, model = (Artifact(stage=s, root=tmp_path / (32 * s), files={}) for s in "abdc")
    store = Store(tmp_path / "store")

    def run(truth: Source, settings: ScoringSettings) -> Artifact:
        return tasks_module.score_training(store, truth, recording, calibration, body, model, settings)

    first = run(truth, ScoringSettings())
    assert run(truth, ScoringSettings()) == first
    assert first.metrics == {"psnr": 30.0}
    assert counted == [tmp_path / (32 * "c")]
    run(truth, ScoringSettings(images=3))
    mesh.write_text("truer")
    for stage in (tasks_module.score_training, tasks_module.score_end_of_training):
        with pytest.raises(InputError, match="ada/ground_truth: changed"):  # nothing may be stored under the old key
            stage(store, truth, recording, calibration, body, model, ScoringSettings(images=4))
    run(read_capture(tmp_path / "ada")[1], ScoringSettings())
    assert len(counted) == 4

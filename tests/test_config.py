import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from pydantic import ValidationError

from hnerf.capture.footage import MAX_FPS, MIN_FPS
from hnerf.config import (
    NerfSettings,
    Settings,
    SyntheticSettings,
    load_settings,
    overridden,
    require_named_files,
    title_of,
    validated,
    with_changes,
)
from hnerf.errors import InputError
from hnerf.study.benchmark.plan import load_study
from hnerf.study.stability.plan import load_stability


def changes(folder: Path, text: str) -> Path:
    path = folder / "changes.yaml"
    path.write_text(text)
    return path


def test_changes_replace_what_they_name_and_nothing_else(tmp_path: Path) -> None:
    """Values change at three depths, and a list is replaced as a whole; everything else keeps the preset's value."""
    full = load_settings("demo")
    text = "training: {steps: 7, losses: {mask: 0.5}, field: {colour_cells: [8]}}\nevaluation: {report_rows: 1}"
    found = with_changes(full, changes(tmp_path, text)).model_dump()
    expected = full.model_dump()
    expected["training"]["steps"] = 7
    expected["training"]["losses"]["mask"] = 0.5
    expected["training"]["field"]["colour_cells"] = (8,)
    expected["evaluation"]["report_rows"] = 1
    assert found == expected


def test_an_empty_file_changes_nothing(tmp_path: Path) -> None:
    assert with_changes(load_settings("fast"), changes(tmp_path, "# nothing")) == load_settings("fast")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("training: {losses: {hair: 0}}", "training.losses.hair"),
        ("training: {steps: -1}", "training.steps"),
        ("training:", "training"),
        ("training: {steps: {a: 1}}", "training.steps"),
        ("asset: {grid_cells: 0}", "asset.grid_cells"),
        ("limits: {reader_gib: 0.1}", "limits.reader_gib"),
        ("limits: {reader_gib: 1.0e+10}", "limits.reader_gib"),
        ("limits: {stage_s: 1.0e+10}", "limits.stage_s"),
        ("limits: {image_s: 1.0e+10}", "limits.image_s"),
        ("asset: {faces: -1}", "asset.faces"),
        ("asset: {texture_px: -1}", "asset.texture_px"),
        ("asset: {texture_px: 8193}", "asset.texture_px"),
        ("asset: {texture_poses: 0}", "asset.texture_poses"),
        ("asset: {splats: -1}", "asset.splats"),
        ("training: {field: {kind: nerf}}", "training: nerf does not tune poses"),
        ("training: {losses: {fog: 0.1}}", "training: fast does not model the background"),
    ],
)
def test_invalid_settings_are_refused_with_file_and_key(tmp_path: Path, text: str, named: str) -> None:
    path = changes(tmp_path, text)
    with pytest.raises(InputError, match=f"{path}: {named}: "):
        with_changes(load_settings("fast"), path)


def test_an_error_of_contradicting_keys_is_one_line_with_one_advice() -> None:
    with pytest.raises(
        InputError, match=r"^a\.yaml: test_cameras: one at most between two training cameras; lower it$"
    ):
        validated(SyntheticSettings, {"train_cameras": 1, "test_cameras": 2}, "a.yaml")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"training: [100", "is not YAML "),
        (b"title: \xe9t\xe9", "is not YAML "),
        (b"title: 2026-13-01", "is not YAML "),
        (b"- training", "does not hold keys and values"),
        (b"fast", "does not hold keys and values"),
    ],
)
@pytest.mark.parametrize(
    "load",
    [
        lambda path: load_settings(str(path), ["training.steps=7"]),
        lambda path: with_changes(load_settings("fast"), path),
        lambda path: load_study(str(path)),
        lambda path: load_stability(str(path)),
    ],
)
def test_an_error_of_a_file_without_keys_is_one_line(
    load: Callable[[Path], Any], content: bytes, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=f"^{path}: {message}[^\n]*$"):
        load(path)


def test_an_error_of_an_override_that_is_not_yaml_is_one_line() -> None:
    with pytest.raises(InputError, match=r"^--set training\.steps=\[100: is not YAML [^\n]*; correct it$"):
        load_settings("fast", ["training.steps=[100"])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("2", "2"), ("1.10", "1.10"), ("2025-01-02", "2025-01-02"), ("'1'", "1"), ("two b", "two b"),
        ("(c) A: all # 3", "(c) A: all # 3"), ("@a [b", "@a [b"), ('"A: b"', "A: b"),
    ],
)  # fmt: skip
def test_text_settings_accept_values_that_look_like_numbers_or_dates(value: str, text: str) -> None:
    settings = load_settings("fast", [f"asset.version={value}", f"evaluation.holdout={value}"])
    assert (settings.asset.version, settings.evaluation.holdout) == (text, text)
    assert load_settings("fast", ["evaluation.holdout=null"]).evaluation.holdout is None


def test_path_settings_are_not_parsed_as_yaml() -> None:
    settings = load_settings("fast", ["segmentation.model=/take #2/1: seg.onnx", "fit.body_model=2024"])
    assert (settings.segmentation.model, settings.fit.body_model) == (Path("/take #2/1: seg.onnx"), Path("2024"))
    assert load_settings("fast", ["segmentation.model=null"]).segmentation.model is None
    assert load_settings("fast", ["fit.body_model=anny"]).fit.body_model == "anny"


def test_an_error_of_a_very_deep_override_is_one_line() -> None:
    key = ".".join(["x"] * 3000)
    with pytest.raises(InputError, match=r"^--set x\.x.*no such key; `hnerf settings` lists them"):
        load_settings("fast", [f"{key}=1", f"{key}=2"])


def test_a_field_without_its_kind_is_refused(tmp_path: Path) -> None:
    path = changes(tmp_path, "training: {field: {width: 5}}")
    with pytest.raises(InputError, match=rf"^{path}: training\.field: 'kind' is missing; add it$"):
        load_settings(str(path))


def test_an_error_names_the_missing_key(tmp_path: Path) -> None:
    path = changes(tmp_path, "methods: [fast]\nvariants: {all: {}}")
    with pytest.raises(InputError, match=rf"^{path}: title: is missing; add it$"):
        load_study(str(path))


def test_a_preset_builds_on_another(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("based_on: nerf-wide\ntraining: {field: {learning_rate: 0.5}}")
    nerf, wide, mine = (load_settings(name).training for name in ("nerf", "nerf-wide", str(path)))
    assert (nerf.field.width, wide.field.width, mine.field.learning_rate) == (64, 256, 0.5)
    assert mine == wide.model_copy(update={"field": wide.field.model_copy(update={"learning_rate": 0.5})})
    (tmp_path / "child.yaml").write_text("based_on: mine.yaml\ntraining: {steps: 7}")
    assert load_settings(str(tmp_path / "child.yaml")).training == mine.model_copy(update={"steps": 7})
    path.write_text("based_on: absent")
    with pytest.raises(InputError, match=rf"^{path}: based_on: absent: no such preset or file"):
        load_settings(str(path))


def test_files_that_settings_name_must_be_there(tmp_path: Path) -> None:
    """The body model `anny` is no file."""
    (tmp_path / "seg.onnx").touch()
    settings = load_settings("fast", [f"segmentation.model={tmp_path}/seg.onnx"])
    require_named_files(settings)
    with pytest.raises(InputError, match=r"^fit\.body_model: anni: no such file; correct the path, or leave it out$"):
        require_named_files(overridden(settings, ["fit.body_model=anni"]))


@pytest.mark.parametrize("content", [b"", b"# training: {steps: 7}", b"\xff\xfe", b"{}"])
def test_a_preset_without_settings_is_refused(tmp_path: Path, content: bytes) -> None:
    """An editor or a full disk left it empty, so its defaults are not meant; nor are those of `fast`."""
    path = tmp_path / "mine.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"^{path}: holds no settings; write some, or a line like `based_on: fast`$"):
        load_settings(str(path), ["training.steps=7"])


def test_a_preset_cannot_build_on_itself(tmp_path: Path) -> None:
    one, other = tmp_path / "one.yaml", tmp_path / "other.yaml"
    one.write_text(f"based_on: {other}")
    other.write_text(f"based_on: {one}")
    with pytest.raises(InputError, match=rf"^{one}: is based on itself; correct based_on in it$"):
        load_settings(str(one))


def test_a_large_file_is_not_read_as_a_preset(tmp_path: Path) -> None:
    """Neither as a preset, nor as the base of one. Files of more than 64 KiB are not read."""
    path = tmp_path / "large.yaml"
    path.write_bytes(b"#" * 65_537)
    (tmp_path / "mine.yaml").write_text(f"based_on: {path}")
    for name in (path, tmp_path / "mine.yaml"):
        with pytest.raises(InputError, match=rf"^{path}: more than 65536 bytes; give a YAML file of settings$"):
            load_settings(str(name))
    path.write_text("training: {} ".ljust(65_536, "#"))
    assert load_settings(str(path)) == Settings()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("training.field.colour_cells=[8,-3]", "training.field.colour_cells.1: "),
        ("training.field.kind=cube", "training.field: "),
        ("training.field={kind: paper, samples: 4, box_samples: 9}", "training.field: "),
        ("fit.body_model=null", "fit.body_model: "),
    ],
)
def test_errors_in_unions_name_the_key_that_was_set(override: str, message: str) -> None:
    with pytest.raises(InputError, match=rf"^--set {re.escape(override)}: {re.escape(message)}"):
        load_settings("fast", [override])


def test_a_new_kind_of_field_starts_from_its_own_defaults() -> None:
    changed = load_settings("demo", ["training.pose_learning_rate=0", "training.field.kind=nerf"]).training
    assert changed.field == NerfSettings()


def test_seeds_that_torch_does_not_accept_are_refused() -> None:
    torch.manual_seed(load_settings("fast", [f"training.seed={2**63 - 1}"]).training.seed)
    with pytest.raises(InputError, match=rf"^--set training\.seed={2**63}: training\.seed: Input should be less than"):
        load_settings("fast", [f"training.seed={2**63}"])


@pytest.mark.parametrize("name", ["a" * 5000, "a\0b", "fa/" * 2000])
def test_an_impossible_file_name_is_not_a_preset(name: str) -> None:
    with pytest.raises(InputError, match="no such preset or file"):
        load_settings(name)


@pytest.mark.parametrize(
    ("name", "title"),
    [("x-0.5", "x-0.5"), ("a/x-0.5.yaml", "x-0.5"), ("x.yml", "x"), ("sub/fast", "fast")],
)
def test_titles_keep_dots(name: str, title: str) -> None:
    """Otherwise the tables of presets x-0.5 and x-0.7 would be the same file."""
    assert title_of(name) == title


def test_synthetic_captures_have_frame_rates_that_the_reader_accepts() -> None:
    for fps in (MIN_FPS, MAX_FPS):
        assert SyntheticSettings(fps=fps).fps == fps
    for fps in (MIN_FPS / 2, 2 * MAX_FPS):
        with pytest.raises(ValidationError, match="fps"):
            SyntheticSettings(fps=fps)

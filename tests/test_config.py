from pathlib import Path

import pytest

from hnerf.config import load_settings, with_changes
from hnerf.errors import CaptureError


def changes(folder: Path, text: str) -> Path:
    path = folder / "changes.yaml"
    path.write_text(text)
    return path


def test_changes_replace_what_they_name_and_nothing_else(tmp_path: Path) -> None:
    """At three depths, with a list that is replaced as a whole; all else as the preset has it."""
    full = load_settings("demo")
    text = "training: {steps: 7, losses: {mask: 0.5}, fast: {colour_cells: [8]}}\nevaluation: {report_rows: 1}"
    found = with_changes(full, changes(tmp_path, text)).model_dump()
    expected = full.model_dump()
    expected["training"]["steps"] = 7
    expected["training"]["losses"]["mask"] = 0.5
    expected["training"]["fast"]["colour_cells"] = (8,)
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
        ("training: {machinery: nerf}", "training: Value error, nerf does not tune poses"),
    ],
)
def test_what_is_not_allowed_is_refused_by_file_and_key(tmp_path: Path, text: str, named: str) -> None:
    path = changes(tmp_path, text)
    with pytest.raises(CaptureError, match=f"{path}: {named}: "):
        with_changes(load_settings("fast"), path)

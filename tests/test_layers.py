"""No package of hnerf/ imports from a layer above it, and hnerf/ imports neither tasks, flows nor Prefect."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import hnerf

ROOT = Path(hnerf.__file__).parent
FOUNDATION = ("errors", "evenly_spaced", "tables", "files", "processes", "pycolmap_import", "warp_import", "progress",
              "side_by_side", "models", "strict_yaml", "config", "onnx_session")  # fmt: skip
FLOORS = (*FOUNDATION, "results", "geometry", "capture", "detection", "body", "synthetic", "segmentation",
          "calibration", "fields", "baselines", "avatar", "training", "render", "evaluation", "asset",
          "study")  # fmt: skip


def imported(path: Path) -> Iterator[str]:
    """Yield the full name of every module and object that a file imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_every_package_has_a_layer() -> None:
    found = {path.stem for path in ROOT.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert found - {"__init__"} == set(FLOORS)


@pytest.mark.parametrize("floor", FLOORS)
def test_a_package_imports_nothing_from_a_layer_above(floor: str) -> None:
    files = [ROOT / f"{floor}.py"] if floor in FOUNDATION else sorted((ROOT / floor).rglob("*.py"))
    below = FLOORS[: FLOORS.index(floor) + 1]
    for path in files:
        for name in imported(path):
            parts = name.split(".")
            assert parts[0] not in ("tasks", "flows", "prefect"), f"{path} imports {name}"
            assert parts[0] != "hnerf" or parts[1] in below, f"{path} imports {name}, which lies above"


@pytest.mark.parametrize("library", ["pycolmap", "warp"])
def test_a_library_is_imported_in_one_place(library: str) -> None:
    """Imported directly, pycolmap would handle signals, and warp would print a banner."""
    assert [path.name for path in ROOT.rglob("*.py") if library in imported(path)] == [f"{library}_import.py"]

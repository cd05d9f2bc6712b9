"""Every program that makes results shows its docstring on --help, and measures nothing."""

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace

import provenance
import pytest
import studies
from registry import REGISTRY

PROGRAMS = sorted({result.command[0].removesuffix(".py") for result in REGISTRY})
STORE = ("store",)
REFUSED = 77  # not an exit code of argparse
POSITIONAL = {  # arguments of programs that need some
    "budget": (*STORE, "out"),
    "fit": STORE,
    "gpu": ("subject", "capture", "out"),
    "limits": STORE,
    "rendering": STORE,
    "scaling": ("scaling", "valid-wave"),
    "studies": ("store", "valid-wave", "benchmark", "quick"),
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_help_is_shown_before_anything_is_measured(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    program = importlib.import_module(name)
    monkeypatch.setattr(sys, "argv", [f"{name}.py", "--help"])
    with pytest.raises(SystemExit) as ended:
        program.main()
    assert ended.value.code == 0
    assert (program.__doc__ or "").splitlines()[0] in capsys.readouterr().out


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_checkout_with_changes_is_refused_before_anything_is_measured(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = importlib.import_module(name)

    def refuse(root: object) -> None:
        raise SystemExit(REFUSED)

    monkeypatch.setattr(provenance, "clean_commit", refuse)
    monkeypatch.setattr(program, "measure", lambda *_: pytest.fail("it measured"), raising=False)
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *POSITIONAL.get(name, ())])
    with pytest.raises(SystemExit) as ended:
        program.main()
    assert ended.value.code == REFUSED


def test_a_study_keeps_the_charts_of_its_own_table_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table, own = tmp_path / "ada-dynamic.md", {"ada-dynamic.csv", "ada-dynamic.png", "ada-dynamic-pictures.png"}
    for name in own | {"ada-dynamic.recording", "ada-dynamic-part.png", "ada-dynamic-converged.png"}:
        (tmp_path / name).touch()
    table.write_text("![ada-dynamic.png](<ada-dynamic.png>)\n![ada-dynamic-pictures.png](<ada-dynamic-pictures.png>)\n")
    flow = SimpleNamespace(benchmark=SimpleNamespace(fn=lambda *_: table))
    changes = {"import_module": lambda _: flow, "provenance": dict, "provenance_line": str, "clean_commit": id}
    for name, change in (changes | {"RESULTS": tmp_path / "results"}).items():
        monkeypatch.setattr(studies, name, change)
    monkeypatch.setattr(sys, "argv", ["studies.py", "store", "ada", "benchmark", "dynamic"])
    studies.main()
    assert {path.name for path in (tmp_path / "results" / "benchmark").iterdir()} == own | {table.name}

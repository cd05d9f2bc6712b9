"""Every program that makes results shows its docstring on --help, and measures nothing."""

import importlib
import sys

import provenance
import pytest
from registry import REGISTRY

PROGRAMS = sorted({result.command[0].removesuffix(".py") for result in REGISTRY})
STORE = ("store",)
REFUSED = 77  # not an exit code of argparse
POSITIONAL = {  # arguments of programs that need some
    "budget": STORE,
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

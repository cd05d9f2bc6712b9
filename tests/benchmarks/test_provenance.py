"""Results are made from clean checkouts only."""

from pathlib import Path

import provenance
import pytest

import hnerf
from tests.benchmarks.checkout import Checkout


@pytest.mark.parametrize("name", ["hnerf/far.py", "configs/new.yaml"])
def test_a_checkout_with_changes_is_refused(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    checkout = Checkout(tmp_path)
    assert len(provenance.clean_commit(checkout.root)) == 12
    checkout.write(name, "NUMBER = 3\n")
    with pytest.raises(SystemExit, match=r"^2$"):
        provenance.clean_commit(checkout.root)
    (line,) = capsys.readouterr().err.splitlines()
    assert f"uncommitted changes in {name} since" in line
    checkout.commit()
    assert len(provenance.clean_commit(checkout.root)) == 12


def test_changed_results_do_not_count_as_uncommitted_changes(tmp_path: Path) -> None:
    checkout = Checkout(tmp_path)
    checkout.write("benchmarks/results/one.md", "1")
    assert provenance.clean_commit(checkout.root)


def test_a_folder_without_commits_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=r"^2$"):
        provenance.clean_commit(tmp_path)
    assert "has no commit" in capsys.readouterr().err


def test_code_of_another_checkout_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(hnerf, "__file__", str(tmp_path / "hnerf" / "__init__.py"))
    with pytest.raises(SystemExit, match=r"^2$"):
        provenance.provenance()
    assert f"give PYTHONPATH={provenance.ROOT}" in capsys.readouterr().err

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from flows import systemd_units as module
from flows.systemd_units import main, units

ROOT, PREFECT = Path("/srv/hnerf"), Path("/srv/hnerf/.venv/bin/prefect")


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_accepts_the_units(tmp_path: Path) -> None:
    root = tmp_path / "a checkout of 100% for $HOME"
    root.mkdir()
    (root / "prefect").touch(mode=0o755)
    paths = []
    for name, text in units(root, root / "prefect").items():
        (tmp_path / name).write_text(text)
        paths.append(str(tmp_path / name))
    command = ["systemd-analyze", "verify", "--man=no", *paths]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert str(tmp_path) not in done.stderr, done.stderr  # it may also complain about other units of the machine
    assert "hnerf" not in done.stderr, done.stderr


def test_both_services_always_restart() -> None:
    for text in units(ROOT, PREFECT).values():
        assert "Restart=always" in text and "StartLimitIntervalSec=0" in text
    assert "Wants=hnerf-server.service" in units(ROOT, PREFECT)["hnerf-worker.service"]


def test_the_worker_opens_no_port() -> None:
    """The health check of Prefect's worker would listen on port 8080 on all addresses."""
    assert "--with-healthcheck" not in units(ROOT, PREFECT)["hnerf-worker.service"]


@pytest.mark.parametrize("name", ['a"b', "a\\b"])
def test_the_error_of_a_path_that_systemd_rejects_is_one_line(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "ROOT", Path("/srv") / name)
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path)])
    assert capsys.readouterr().err == f'/srv/{name}: systemd takes no path with " or \\; move the checkout\n'
    assert list(tmp_path.iterdir()) == []


def test_the_units_are_written_only_into_an_existing_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([str(tmp_path)])
    assert {path.name for path in tmp_path.iterdir()} == set(units(ROOT, PREFECT))
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path / "none")])
    assert capsys.readouterr().err == f"{tmp_path / 'none'}: no such folder; make it first\n"


def test_the_units_run_the_prefect_of_the_python_that_writes_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In a checkout without .venv, units for .venv/bin/prefect would be restarted for ever."""
    main([str(tmp_path)])
    beside = Path(sys.executable).with_name("prefect")
    assert f'\nExecStart="{beside}" worker start' in (tmp_path / "hnerf-worker.service").read_text()
    (tmp_path / "units").mkdir()
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path / "units")])
    assert capsys.readouterr().err.startswith(f"{tmp_path}/prefect: no such program; run `make install`")
    assert list((tmp_path / "units").iterdir()) == []

import shutil
import subprocess
from pathlib import Path

import pytest

from flows import systemd_units as module
from flows.systemd_units import main, units


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_accepts_the_units(tmp_path: Path) -> None:
    root = tmp_path / "a checkout of 100% for $HOME"
    (root / ".venv" / "bin").mkdir(parents=True)
    (root / ".venv" / "bin" / "prefect").touch(mode=0o755)
    paths = []
    for name, text in units(root).items():
        (tmp_path / name).write_text(text)
        paths.append(str(tmp_path / name))
    command = ["systemd-analyze", "verify", "--man=no", *paths]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert str(tmp_path) not in done.stderr, done.stderr  # it may also complain about other units of the machine
    assert "hnerf" not in done.stderr, done.stderr


def test_both_services_always_restart() -> None:
    for text in units(Path("/srv/hnerf")).values():
        assert "Restart=always" in text and "StartLimitIntervalSec=0" in text
    assert "Wants=hnerf-server.service" in units(Path("/srv/hnerf"))["hnerf-worker.service"]


def test_the_worker_opens_no_port() -> None:
    """The health check of Prefect's worker would listen on port 8080 on all addresses."""
    assert "--with-healthcheck" not in units(Path("/srv/hnerf"))["hnerf-worker.service"]


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
    assert {path.name for path in tmp_path.iterdir()} == set(units(tmp_path))
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path / "none")])
    assert capsys.readouterr().err == f"{tmp_path / 'none'}: no such folder; make it first\n"

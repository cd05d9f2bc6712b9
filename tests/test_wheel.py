"""A wheel contains every file that the code reads; setuptools itself lists its contents."""

from pathlib import Path

import pytest
from setuptools import Distribution

ROOT = Path(__file__).parents[1]
PACKAGED = ("configs", "flows", "hnerf", "tasks")


def test_a_wheel_contains_all_files_of_the_packages_and_all_presets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    distribution = Distribution()
    distribution.script_name = "setup.py"  # setuptools needs it, but does not set it here
    distribution.parse_config_files()
    distribution.include_package_data = False  # this would query a version control system, which may be absent
    build = distribution.get_command_obj("build_py")
    build.build_lib = str(tmp_path)
    build.ensure_finalized()
    packed = {Path(source) for source in build.get_output_mapping().values()}
    files = {path.relative_to(ROOT) for name in PACKAGED for path in (ROOT / name).rglob("*.*") if path.is_file()}
    assert {path for path in files if path.suffix != ".pyc"} - packed == set()
    assert Path("configs/stability/full.yaml") in packed

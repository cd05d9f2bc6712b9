import dataclasses
import json
import os
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from hnerf.asset import blender
from hnerf.asset.blender import FILES, SCRIPT, require_blender, write_with_blender
from hnerf.asset.package import write_cache, write_usdz
from hnerf.asset.rigs import FULL
from hnerf.asset.staging import StagedAvatar
from hnerf.errors import InputError
from tests.asset.figure import INFO

FPS = 29.97


def write_program(path: Path, script: str) -> str:
    """Write a program in place of Blender's."""
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return str(path)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("blender-5.0", ["--background", "--factory-startup", "--python-exit-code", "1", "--python"]),
        ("python3.11", ["-I"]),
    ],
)
def test_the_program_runs_the_script_in_the_folder(
    name: str, options: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_program(tmp_path / name, f"printf '%s\\n' \"$@\" > given; cat >> given; touch {' '.join(FILES)}")
    (tmp_path / "out").mkdir()
    write_with_blender(tmp_path / "out", f"./{name}", 29.97)
    assert (tmp_path / "out" / "given").read_text().splitlines() == [*options, str(SCRIPT), "--", "29.97"]
    assert {path.name for path in tmp_path.iterdir()} == {name, "out"}


def test_a_program_is_found_on_the_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_program(tmp_path / "blender-on-path", f'test "$#" = 7 && test "$PWD" != {os.getcwd()}')
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    require_blender("blender-on-path")


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("echo Traceback; echo \"ModuleNotFoundError: no 'bpy'\" >&2; echo; echo Blender quit; exit 1", "ModuleNot"),
        ("echo flatpak: no such app; echo; exit 1", "flatpak: no such app; give --blender"),
        ("exit 3", "exit code 3; give --blender"),
        ("kill -SEGV $$", "exit code -11; give --blender"),
        (f"touch {FILES[0]}", f"wrote no {FILES[1]}; give --blender"),
    ],
)
def test_a_failure_names_the_program_and_says_why(script: str, message: str, tmp_path: Path) -> None:
    program = write_program(tmp_path / "blender", script)
    with pytest.raises(InputError, match=f"^{program}: {message}"):
        write_with_blender(tmp_path, program, FPS)


def test_files_that_are_no_programs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"blender: no such program; give --blender Blender 4\.5 or newer, or a"):
        require_blender(str(tmp_path / "blender"))
    (tmp_path / "blender").write_text("not a program")
    (tmp_path / "blender").chmod(0o755)
    with pytest.raises(InputError, match=r"blender: cannot be started \(Exec format error\)"):
        require_blender(str(tmp_path / "blender"))


@pytest.mark.parametrize(
    ("version", "usd", "message"),
    [((4, 4, 3), True, "4.4.3;"), ((5, 0, 1), False, "5.0.1 without usd;"), ((4, 5, 0), True, None)],
)
def test_an_unsuitable_blender_is_refused(
    version: tuple[int, ...], usd: bool, message: str | None, tmp_path: Path
) -> None:
    """The module is a stand-in, and so is the program, which skips Blender's five options."""
    app = f"version={version}, version_string='{'.'.join(map(str, version))}', build_options=S(usd={usd}, alembic=True)"
    (tmp_path / "bpy.py").write_text(f"from types import SimpleNamespace as S\napp = S({app})\n")
    (tmp_path / "bpy_extras").mkdir()
    (tmp_path / "bpy_extras" / "node_shader_utils.py").write_text("PrincipledBSDFWrapper = None\n")
    program = write_program(tmp_path / "blender", f'shift 5; PYTHONPATH={tmp_path} exec {sys.executable} "$@"')
    if message is None:
        require_blender(program)
        return
    with pytest.raises(InputError, match=f"RuntimeError: it is Blender {message} give --blender Blender 4.5 or newer"):
        require_blender(program)


def test_a_program_that_takes_too_long_is_ended_with_what_it_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(blender, "LIMIT_S", 1.0)
    program = write_program(tmp_path / "blender", f"sleep 100 & echo $! > {tmp_path}/started; wait")
    with pytest.raises(InputError, match="blender: took over 1 s"):
        require_blender(program)
    status = Path("/proc", (tmp_path / "started").read_text().strip(), "stat")
    until = time.monotonic() + 10
    while status.exists() and status.read_text().split()[2] != "Z":
        assert time.monotonic() < until, "it is still running"
        time.sleep(0.05)


@pytest.fixture
def program() -> str:
    """Return Blender's program."""
    named = os.environ.get("HNERF_BLENDER") or shutil.which("blender")
    if not named:
        pytest.skip("there is no Blender: neither on PATH nor named by HNERF_BLENDER")
    return named


def with_longer_motion(staged: StagedAvatar) -> StagedAvatar:
    """Return an avatar with another motion, which lasts longer than the captured one."""
    rigs = {}
    for name, rig in staged.rigs.items():
        captured = rig.motions["captured"]
        motions = {**rig.motions, "nod": dataclasses.replace(captured, codes=captured.codes + 40)}
        rigs[name] = dataclasses.replace(rig, motions=motions)
    return dataclasses.replace(staged, rigs=rigs, extents_m=staged.extents_m | {"nod": staged.extents_m["captured"]})


def test_blender_reads_back_what_it_wrote(
    staged: StagedAvatar, program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The avatar has poses in frames 3, 4, 5 and 8; the files have all frames from 3 to 8. The rate is the given one,
    since Blender does not read that of USD."""
    write_usdz(tmp_path / "avatar.usdz", {"": with_longer_motion(staged)}, [], 10.0, INFO)
    write_cache(tmp_path / "avatar_cache.usdz", staged, [], 10.0, INFO)
    require_blender(program)
    write_with_blender(tmp_path, program, FPS)
    assert str(tmp_path).encode() not in (tmp_path / "avatar.fbx").read_bytes()  # nor the user's name in it
    monkeypatch.setattr(blender, "SCRIPT", Path(__file__).with_name("blender_read.py"))
    blender._run(program, tmp_path, str(FPS))
    read = json.loads((tmp_path / "read.json").read_text())
    fbx, abc, skeleton = read["fbx"], read["abc"], staged.rigs[FULL].skeleton
    rows = [staged.frames.tolist().index(frame) for frame in (3, 5, 8)]
    np.testing.assert_allclose(fbx["points_m"], staged.points_m[rows], atol=1e-5)
    np.testing.assert_allclose(abc["points_m"], staged.points_m[rows], atol=1e-6)
    assert fbx["fps"] == pytest.approx(FPS, abs=1e-6)
    np.testing.assert_allclose(fbx["keys"], range(3, 9), atol=1e-4)
    assert abc["range"] == [3, 8] and abc["uvs"] == 1
    parents = [None if parent < 0 else skeleton.names[parent] for parent in skeleton.parents]
    assert {name: parent for name, (parent, _) in fbx["bones"].items()} == dict(
        zip(skeleton.names, parents, strict=True)
    )
    heads_m = [fbx["bones"][name][1] for name in skeleton.names]
    np.testing.assert_allclose(heads_m, skeleton.bind[:, :3, 3], atol=1e-6)
    assert set(fbx["groups"]) <= set(skeleton.names) and len(fbx["groups"]) >= 2
    assert fbx["shapes"] == ["Basis", *staged.blend_shapes_m]
    assert fbx["texture"] == [64, 64] and all(fbx["embedded"]) and fbx["colours"] == 0
    assert fbx["stated"] == {"UpAxis": 1, "UnitScaleFactor": 100.0, "SpecularFactor": 0.0}  # the unit in centimetres
    np.testing.assert_allclose(fbx["scale"], 1, atol=1e-6)
    assert fbx["sides"] == len(staged.faces)

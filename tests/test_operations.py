"""The commands of docs/operations.md: each is executed as written there, or left out for a stated reason."""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import httpx
import numpy as np
import pytest

from tests.prefect_server import free_port
from tests.shared_data import SHARED_DATA as SHARED

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "operations.md"
COMMAND = re.compile(r"^    (\S.*?)(?: {2,}# .*)?$", re.MULTILINE)
NO_COMMANDS = r"store/\S+ {3,}|-p 'overrides|\[Service\]|Environment="
LEFT_OUT = {
    r"hnerf (ablate|benchmark|stability|demo|synth (ring|walk))": "hours; the same flows on small studies: tests/flows",
    r"hnerf view": "serves until it is interrupted: tests/render/test_page.py",
    r"hnerf models|git pull": "fetches from registries: make install",
    r"evaluation.holdout=(each|cam03)": "as the third of them, with another camera",
    r"systemctl|loginctl|journalctl|~/.config/systemd": "services: tests/flows/test_systemd_units.py",
    r"sudo|pg_dump|dropdb|DATABASE|database upgrade": "PostgreSQL: tests/flows/test_postgresql.py",
    r"ln -s": "a mount: tests/soak.py",
    r"s3://BUCKET/captures": "captures in a bucket: tests/flows/test_train_subject.py, tests/soak.py",
    r"docker|(?i:kubernetes)|kubectl|containers\]|mkdir -p store c": "containers: tests/flows/test_work_pools.py",
}
LATER = r"prefect (server|worker) start"  # these run until the end of the test
SMALL = """training: {field: {kind: fast, colour_cells: [24, 64], spacing_m: 0.02}, steps: 12, novel_pose_steps: 2}
detection: {hands: none}
evaluation: {max_images: 1, max_meshes: 1, report_rows: 1}
asset: {grid_cells: 48, faces: 1500, texture_px: 64, texture_poses: 1, photograph_frames: 1, correctives: 0}
"""
SIZES = {"size_px": 96, "train_cameras": 5, "test_cameras": 0, "train_frames": 4, "novel_pose_frames": 1}
PATIENCE_S = 3600.0


def commands() -> list[str]:
    """Return the commands of the page."""
    return [line for line in COMMAND.findall(PAGE.read_text()) if not re.match(NO_COMMANDS, line)]


def reason(command: str) -> str:
    """Return why a command is left out, or an empty text if it is executed."""
    return next((why for pattern, why in LEFT_OUT.items() if re.search(pattern, command)), "")


def test_at_least_30_commands_of_the_page_are_executed() -> None:
    executed = [command for command in commands() if not reason(command)]
    assert len(executed) >= 30
    for command in executed:
        assert re.match(r"\.venv/bin/|grep |curl |export ", command), command


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Return a copy of the tracked files, as after `make install`, with a tiny preset."""
    folder = tmp_path / "checkout"
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in listed.rstrip("\0").split("\0"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, folder / name)
    (folder / "configs" / "fast.yaml").write_text(SMALL)
    bin_ = folder / ".venv" / "bin"
    bin_.mkdir(parents=True)
    for name, code in {
        "python": 'exec {python} "$@"',
        "prefect": 'exec {python} -m prefect "$@"',
        "hnerf": "exec {python} -c 'import sys; from flows.cli import main; sys.exit(main())' \"$@\"",
    }.items():
        (bin_ / name).write_text(f"#!/bin/sh\n{code.format(python=shlex.quote(sys.executable))}\n")
        (bin_ / name).chmod(0o755)
    return folder


def write_stand_ins(folder: Path) -> dict[str, str]:
    """Write files for the commands; return the text to put in place of each placeholder of the page."""
    from hnerf.config import SyntheticSettings
    from hnerf.synthetic import write_synthetic_capture

    write_synthetic_capture(folder / "captures" / "ada", SyntheticSettings(**SIZES))
    manifest = folder / "captures" / "ada" / "capture.toml"
    manifest.write_text(manifest.read_text().replace('name = "performer"', 'name = "ada"'))
    np.savez(folder / "dance.npz", poses=np.zeros((5, 156)), trans=np.zeros((5, 3)))
    (folder / "mnt").mkdir()
    return {
        "/path/to/capture": f"{folder}/captures/ada",
        "CAPTURE": "captures/ada",
        "SUBJECT": "store/subjects/ada",
        "walk.bvh": "store/subjects/ada/asset/avatar.bvh",
        "training.steps=2000": "training.steps=14",
        "--frames 12": "--frames 2",
        "s3://BUCKET/hnerf": f"file://{folder}/mnt",
        "synth OUT": "synth out --set train_frames=2 --set size_px=64",
    }


def copy_shared_stand_ins(folder: Path) -> dict[str, str]:
    """Copy the real captures that some commands need; return the text to put in place of each placeholder."""
    shutil.copytree(SHARED / "pose2sim-balance", folder / "balance")
    shutil.copytree(SHARED / "caliscope-charuco", folder / "boards")
    shutil.copytree(SHARED / "valid-walk", folder / "apart")
    return {
        "calibrate FOLDER": "calibrate boards --out rig",
        "calibrate CAPTURE": "calibrate balance --out people",
        "synchronise CAPTURE": "synchronise apart",
    }


def environment(folder: Path) -> dict[str, str]:
    """Return the environment of the commands, with a Prefect server of their own."""
    port = free_port()
    return os.environ | {
        "PREFECT_HOME": str(folder / ".prefect"),
        "PREFECT_SERVER_API_PORT": str(port),
        "PREFECT_API_URL": f"http://127.0.0.1:{port}/api",
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": str(folder),
    }


def start(command: str, folder: Path, variables: dict[str, str]) -> "subprocess.Popen[bytes]":
    """Start a command that runs until the end of the test; return once the Prefect server answers."""
    # Prefect's worker ends on SIGINT, which is ignored if the tests run as a shell's background job.
    listens = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    started = subprocess.Popen(shlex.split(command), cwd=folder, env=variables, preexec_fn=listens)
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            httpx.get(f"{variables['PREFECT_API_URL']}/health", timeout=2).raise_for_status()
            return started
        except httpx.HTTPError:
            assert started.poll() is None and time.monotonic() < deadline_s
            time.sleep(1)


def executable(names: dict[str, str]) -> Iterator[str]:
    """Yield the commands to execute, with their placeholders replaced."""
    for command in commands():
        if reason(command) or (not SHARED.is_dir() and re.search("calibrate|synchronise", command)):
            continue
        for name, stand_in in names.items():
            command = command.replace(name, stand_in)
        yield command


@pytest.mark.soak
def test_every_command_works(checkout: Path) -> None:
    names = (copy_shared_stand_ins(checkout) if SHARED.is_dir() else {}) | write_stand_ins(checkout)
    variables = environment(checkout)
    names |= {"4200": variables["PREFECT_SERVER_API_PORT"], "deployment run": "deployment run --watch"}
    subprocess.run(".venv/bin/python -m flows.server_password > .env", shell=True, cwd=checkout, check=True)
    running = []
    try:
        for command in executable(names):
            print(f"$ {command}", flush=True)
            if re.search(LATER, command):
                running.append(start(command, checkout, variables))
            elif command.startswith("export "):
                variables |= dict([command.removeprefix("export ").split("=", 1)])
            else:
                subprocess.run(["bash", "-c", command], cwd=checkout, env=variables, check=True, timeout=PATIENCE_S)
    finally:
        for process in running[::-1]:
            process.terminate()
            process.wait(timeout=120)
    assert list((checkout / "mnt").glob("asset/*.tar"))
    assert (checkout / "other" / "subjects" / "ada" / "asset" / "avatar.usdz").is_file()

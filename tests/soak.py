"""Many small recordings through server, schedule and worker, while processes are killed now and then:

    python tests/soak.py [--subjects 6] [--kill-every 120] [--out soak.json]

Everything happens in a folder of its own. Kills alternate: the process of a run, with its worker alive; and the worker
with all that it has started, as when a machine goes down. In the end every recording must have its asset, every
artifact must have been made once, the store must verify clean, and no process may be left. The exit status says so.
"""

import argparse
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

ROOT = Path(__file__).parents[1]
MARK = "HNERF_SOAK"  # in the environment of every process that is started here
SIZES = {"size_px": 96, "train_cameras": 4, "test_cameras": 1, "train_frames": 4, "novel_pose_frames": 1}
PRESET = """based_on: demo
detection: {hands: none}
training: {steps: 12, novel_pose_steps: 2}
evaluation: {max_images: 1, max_meshes: 1, report_rows: 1}
asset: {grid_cells: 48, faces: 1500, texture_px: 64, texture_poses: 1, photograph_frames: 1, correctives: 0}
"""
SILENCE_S, LOOK_S, POLL_S = 90, 30, 1.0


def main() -> int:
    """Run what the command line says; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=6)
    parser.add_argument("--kill-every", type=float, default=120.0, metavar="S")
    parser.add_argument("--limit", type=float, default=6 * 3600.0, metavar="S", help="give up after so long")
    parser.add_argument("--out", type=Path, help="also write the figures into this JSON file")
    options = parser.parse_args()
    scratch = Path(tempfile.mkdtemp(prefix="hnerf-soak-"))
    mark = uuid4().hex
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    os.environ |= {
        MARK: mark,
        "PREFECT_HOME": str(scratch / "prefect"),
        "PREFECT_API_URL": f"http://127.0.0.1:{port}/api",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "DO_NOT_TRACK": "1",
        "OMP_NUM_THREADS": "1",
    }
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended"))  # so that nothing is left running
    try:
        figures = soak(scratch, port, mark, options)
    finally:
        for pid in marked(mark):
            os.kill(pid, signal.SIGKILL)
    text = json.dumps(figures, indent=1)
    print(text)
    if options.out:
        options.out.write_text(text + "\n")
    if figures["faults"]:
        print(f"left for a look: {scratch}", file=sys.stderr)
        return 1
    shutil.rmtree(scratch)
    return 0


def soak(scratch: Path, port: int, mark: str, options: argparse.Namespace) -> dict[str, Any]:
    """Train all recordings under fire; return the figures, among which are the faults."""
    names = write_captures(scratch / "captures", options.subjects)
    (scratch / "preset.yaml").write_text(PRESET)
    store, kills, generations = scratch / "store", list[str](), dict[str, set[int]]()
    with process(scratch, "server", "server", "start", "--host", "127.0.0.1", "--port", str(port), "--no-ui") as server:
        set_up(scratch)
        started_s, killed_s, memory_kib = time.monotonic(), time.monotonic(), [resident_kib(server.pid)]
        worker = start(scratch, "worker", "worker", "start", "--pool", "local", "--type", "process")
        while len(done := finished(store, names)) < len(names) and time.monotonic() - started_s < options.limit:
            time.sleep(POLL_S)
            note_generations(store, generations)
            if time.monotonic() - killed_s > options.kill_every and (run := run_of(worker.pid)):
                kills.append(kill(run, worker, whole=len(kills) % 2 == 1))
                if worker.poll() is not None:
                    worker = start(scratch, "worker", "worker", "start", "--pool", "local", "--type", "process")
                killed_s = time.monotonic()
        seconds = time.monotonic() - started_s
        wait_until_idle()
        states = run_states()
        memory_kib.append(resident_kib(server.pid))
        worker.terminate()
        worker.wait(timeout=120)
    time.sleep(5)
    note_generations(store, generations)
    faults = [f"{name}: no asset" for name in names if name not in done]
    faults += [f"{name}: made {len(made)} times" for name, made in generations.items() if len(made) > 1]
    faults += [f"process {pid} is left: {command(pid)}" for pid in marked(mark)]
    faults += verify(store)
    return {
        "subjects": len(names),
        "finished": len(done),
        "seconds": round(seconds),
        "kills": {what: kills.count(what) for what in ("run", "worker and run")},
        "runs": states,
        "artifacts": len(generations),
        "made_twice": sum(len(made) > 1 for made in generations.values()),
        "server_mib": [kib // 1024 for kib in memory_kib],
        "faults": faults,
    }


def write_captures(folder: Path, count: int) -> list[str]:
    """Write synthetic recordings, each with its own noise; return their names."""
    from hnerf.config import SyntheticSettings
    from hnerf.synthetic import write_synthetic_capture

    names = [f"person{i:02d}" for i in range(count)]
    for seed, name in enumerate(names):
        write_synthetic_capture(folder / name, SyntheticSettings(seed=seed, **SIZES))
        manifest = folder / name / "capture.toml"
        manifest.write_text(manifest.read_text().replace('name = "performer"', f'name = "{name}"'))
    return names


def set_up(scratch: Path) -> None:
    """Make work pool, deployments, automations, and a schedule that looks into the folder all the time."""
    from prefect import get_client
    from prefect.client.schemas.actions import DeploymentScheduleCreate, DeploymentUpdate
    from prefect.client.schemas.schedules import IntervalSchedule

    wait_for_server()
    run("prefect", "--no-prompt", "work-pool", "create", "local", "--type", "process")
    run("prefect", "--no-prompt", "deploy", "--all")
    run("flows.automations", "--silence", str(SILENCE_S))
    places = {"folder": scratch / "captures", "store": scratch / "store", "preset": scratch / "preset.yaml"}
    parameters = {name: str(path) for name, path in places.items()} | {"settle_s": 0, "max_restarts": 20}
    schedule = DeploymentScheduleCreate(schedule=IntervalSchedule(interval=timedelta(seconds=LOOK_S)))
    with get_client(sync_client=True) as client:
        deployment = client.read_deployment_by_name("ingest-captures/local")
        client.update_deployment(deployment.id, DeploymentUpdate(parameters=parameters))
        for known in deployment.schedules:
            client.delete_deployment_schedule(deployment.id, known.id)
        client.create_deployment_schedules(deployment.id, [(schedule.schedule, True)])


def kill(run: int, worker: "subprocess.Popen[bytes]", whole: bool) -> str:
    """Kill a run, or its worker with all that it started; return which."""
    if not whole:
        os.kill(run, signal.SIGKILL)
        return "run"
    everything = [worker.pid, *descendants(worker.pid)]
    for pid in everything:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    worker.wait()
    return "worker and run"


def run_of(worker: int) -> int | None:
    """Return the process of some run that the worker started, after a random while in it."""
    runs = [
        pid for pid in descendants(worker) if "prefect.flow_engine" in command(pid) or "prefect.engine" in command(pid)
    ]
    if not runs:
        return None
    time.sleep(random.uniform(0, 20))
    alive = [pid for pid in runs if Path(f"/proc/{pid}").exists()]
    return random.choice(alive) if alive else None


def note_generations(store: Path, generations: dict[str, set[int]]) -> None:
    """Note each record that is there: one that was written again is another file."""
    for record in store.glob("*/*.json"):
        if len(record.stem) == 32:
            try:
                generations.setdefault(f"{record.parent.name}/{record.stem}", set()).add(record.stat().st_ino)
            except FileNotFoundError:
                continue


def finished(store: Path, names: list[str]) -> set[str]:
    """Return the people who have an asset and a report."""
    wanted = ("asset/avatar.usdz", "evaluation/report.html")
    return {name for name in names if all((store / "subjects" / name / path).exists() for path in wanted)}


def wait_until_idle(patience_s: float = 180.0) -> None:
    """Wait until no run is running any more; the results are all there."""
    deadline_s = time.monotonic() + patience_s
    while time.monotonic() < deadline_s and run_states().get("RUNNING", 0):
        time.sleep(POLL_S)


def run_states() -> dict[str, int]:
    """Return how many training runs are in each state."""
    from prefect import get_client
    from prefect.client.schemas.filters import FlowFilter, FlowFilterName

    with get_client(sync_client=True) as client:
        runs = client.read_flow_runs(flow_filter=FlowFilter(name=FlowFilterName(any_=["train-subject"])))
    states = [one.state_type.value for one in runs if one.state_type]
    return {state: states.count(state) for state in sorted(set(states))}


def verify(store: Path) -> list[str]:
    """Return what is wrong in the store, and what interrupted work has left."""
    from tasks.garbage import find_garbage
    from tasks.inventory import Inventory
    from tasks.store import Store
    from tasks.verify import faults

    left = [one for one in find_garbage(Inventory.of(Store(store)), 1, 0) if one.left]
    return faults(Store(store)).lines + [f"{one.stage}/{one.key}: unfinished" for one in left]


@contextmanager
def process(scratch: Path, name: str, *arguments: str) -> Iterator["subprocess.Popen[bytes]"]:
    """Run a Prefect command as long as the block lasts."""
    started = start(scratch, name, *arguments)
    try:
        yield started
    finally:
        started.terminate()
        started.wait(timeout=60)


def start(scratch: Path, name: str, *arguments: str) -> "subprocess.Popen[bytes]":
    """Start a Prefect command whose output goes into a file."""
    with (scratch / f"{name}.log").open("ab") as log:
        return subprocess.Popen([sys.executable, "-m", "prefect", *arguments], cwd=ROOT, stdout=log, stderr=log)


def run(module: str, *arguments: str) -> None:
    """Run a command to its end."""
    subprocess.run([sys.executable, "-m", module, *arguments], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)


def wait_for_server(patience_s: float = 300.0) -> None:
    """Wait until the server answers."""
    import httpx

    deadline_s = time.monotonic() + patience_s
    while True:
        try:
            httpx.get(f"{os.environ['PREFECT_API_URL']}/health", timeout=2.0).raise_for_status()
            return
        except httpx.HTTPError:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(POLL_S)


def marked(mark: str) -> list[int]:
    """Return the processes, other than this one, that were started from here."""
    found = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        try:
            if f"{MARK}={mark}".encode() in path.read_bytes() and int(path.parent.name) != os.getpid():
                found.append(int(path.parent.name))
        except OSError:
            continue
    return found


def children(pid: int) -> list[int]:
    """Return the processes that a process started."""
    try:
        text = " ".join(path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/children"))
    except OSError:
        return []
    return [int(child) for child in text.split()]


def descendants(pid: int) -> list[int]:
    """Return a process's children, their children, and so on."""
    return [one for child in children(pid) for one in (child, *descendants(child))]


def command(pid: int) -> str:
    """Return a process's command line."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""


def resident_kib(pid: int) -> int:
    """Return the memory that a process holds."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS"))


if __name__ == "__main__":
    sys.exit(main())

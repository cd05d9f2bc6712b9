"""Train many small recordings through a server, a schedule, two workers and a bucket, while processes are killed:

    python tests/soak.py [--subjects 6] [--kill-every 120]

The recordings are in the bucket; everything else is in a temporary folder. The workers are simulated machines with
separate stores (tests/machines.py), which share artifacts through moto's S3 server. Kills alternate between two kinds:
the process of a run, whose worker stays alive; and a whole machine with its processes and its disk, which an empty
machine replaces. In the end, every recording must have its results, the bucket must hold them, every artifact must have
been put there exactly once, the stores must verify clean, a third machine must get everything from the bucket, and no
process may be left. The exit status is 1 if one of these conditions fails.
"""

import argparse
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.machines import MARK, ROOT, Machine, command, marked, process, resident_kib
from tests.postgresql import BINARIES, cluster
from tests.prefect_server import free_port, wait_for

SIZES = {"size_px": 96, "train_cameras": 4, "test_cameras": 1, "train_frames": 4, "novel_pose_frames": 1}
PRESET = """based_on: demo
detection: {hands: none}
training: {steps: 12, novel_pose_steps: 2}
evaluation: {max_images: 1, max_meshes: 1, report_rows: 1}
asset: {grid_cells: 48, faces: 1500, texture_px: 64, texture_poses: 1, photograph_frames: 1, correctives: 0}
"""
SILENCE_S, LOOK_S, POLL_S = 90, 30, 2.0
BUCKET, CAPTURES = "soak", "s3://soak/captures"
RESULTS = {"asset": "avatar.usdz", "evaluation": "report.html"}  # a file that each of these stages writes
MACHINES = 2
LIMIT_S, IDLE_S = 6 * 3600.0, 180.0  # for all recordings to be trained, and for the last runs to end


def main() -> int:
    """Run the soak test with the options of the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=6)
    parser.add_argument("--kill-every", type=float, default=120.0, metavar="S")
    options = parser.parse_args()
    figures = under_fire(options.subjects, options.kill_every)
    print(json.dumps(figures, indent=1))
    return 1 if figures["faults"] else 0


def under_fire(subjects: int, kill_every_s: float) -> dict[str, Any]:
    """Run the soak test in a new folder, which is kept only if there were faults; return the figures."""
    scratch = Path(tempfile.mkdtemp(prefix="hnerf-soak-"))
    mark = uuid4().hex
    server_port, bucket_port = free_port(), free_port()
    os.environ |= {
        "PREFECT_HOME": str(scratch / "prefect"),
        "PREFECT_API_URL": f"http://127.0.0.1:{server_port}/api",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "DO_NOT_TRACK": "1",
        "OMP_NUM_THREADS": "1",
        "HNERF_BUCKET": f"s3://{BUCKET}/shared",
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{bucket_port}",
        "AWS_ACCESS_KEY_ID": "soak",
        "AWS_SECRET_ACCESS_KEY": "soak",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended"))  # so that nothing is left running
    try:
        with database():
            os.environ[MARK] = mark
            figures = soak(scratch, (server_port, bucket_port), mark, subjects, kill_every_s)
    finally:
        for pid in marked(f"{MARK}={mark}"):
            os.kill(pid, signal.SIGKILL)
    if figures["faults"]:
        print(f"left for a look: {scratch}", file=sys.stderr)
    else:
        shutil.rmtree(scratch)
    return figures


def soak(scratch: Path, ports: tuple[int, int], mark: str, subjects: int, kill_every_s: float) -> dict[str, Any]:
    """Train all recordings in a folder, with a server and a bucket at these ports; return the figures, including the
    faults."""
    server_port, bucket_port = ports
    names = write_captures(scratch / "captures", subjects)
    (scratch / "preset.yaml").write_text(PRESET)
    listen = ("--host", "127.0.0.1", "--port", str(server_port), "--no-ui")
    done: dict[str, list[str]] = {}
    kills: Counter[str] = Counter()
    restarts = 0
    with (
        process(scratch, "s3", "moto.server", "-H", "127.0.0.1", "-p", str(bucket_port)),
        process(scratch, "server", "prefect", "server", "start", *listen) as server,
    ):
        set_up(scratch)
        machines = [Machine.started(scratch, number) for number in range(MACHINES)]
        started_s, memory_kib = time.monotonic(), [resident_kib(server.pid)]
        kill_s = started_s + kill_every_s
        while len(done) < len(names) and time.monotonic() - started_s < LIMIT_S:
            time.sleep(POLL_S)
            note_finished(scratch, names, done)
            restarted = [machine.restarted() for machine in machines]
            restarts += sum(now is not before for now, before in zip(restarted, machines, strict=True))
            machines, at = restarted, random.randrange(MACHINES)
            if time.monotonic() < kill_s:
                continue
            kill_s = time.monotonic() + kill_every_s * random.uniform(0.5, 1.5)
            if run := machines[at].run():  # without a run, skip it: later it might hit the last
                if kills.total() % 2:
                    machines[at] = machines[at].lose()
                else:
                    os.kill(run, signal.SIGKILL)
                kills["machine and disk" if kills.total() % 2 else "run"] += 1
        seconds = time.monotonic() - started_s
        wait_until_idle()
        states = run_states()
        memory_kib.append(resident_kib(server.pid))
        for machine in machines:
            machine.stop()
        time.sleep(5)
        puts = shared_artifacts(scratch)
        faults = [f"{name}: no results" for name in names if name not in done]
        faults += [f"{name}: not in the bucket" for made in done.values() for name in made if name not in puts]
        faults += [f"{name}: put into the bucket {count} times" for name, count in puts.items() if count > 1]
        for machine in machines:
            faults += verify(machine.disk)
        faults += verify(fetched(scratch / "third", list(puts)))
    faults += [f"process {pid} is left: {command(pid)}" for pid in marked(f"{MARK}={mark}")]
    logs = "".join(path.read_text(errors="replace") for path in scratch.glob("worker*.log"))
    return {
        "subjects": len(names),
        "database": "PostgreSQL" if BINARIES else "SQLite",
        "finished": len(done),
        "seconds": round(seconds),
        "kills": dict(kills),
        "workers_that_ended_by_themselves": restarts,
        "runs": states,
        "artifacts": len(puts),
        "made_twice": sum(count > 1 for count in puts.values()),
        "fetched_by_another_machine": logs.count("hnerf.shared - fetching "),
        "server_mib": [kib // 1024 for kib in memory_kib],
        "faults": faults,
    }


@contextmanager
def database() -> Iterator[None]:
    """Give the server a PostgreSQL of its own, if installed: on SQLite, two workers of a busy machine can make it
    wait for minutes."""
    if not BINARIES:
        yield
        return
    with cluster() as environment:
        url = f"postgresql+asyncpg://postgres@127.0.0.1:{environment['PGPORT']}/postgres"
        os.environ["PREFECT_SERVER_DATABASE_CONNECTION_URL"] = url
        yield


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
    """Put the recordings into a new bucket; make the work pool, the deployments, the automations, and a schedule that
    looks into the bucket every LOOK_S."""
    from fsspec import filesystem
    from prefect import get_client
    from prefect.client.schemas.actions import DeploymentScheduleCreate, DeploymentUpdate
    from prefect.client.schemas.schedules import IntervalSchedule

    for url in (f"{os.environ['PREFECT_API_URL']}/health", os.environ["AWS_ENDPOINT_URL"]):
        wait_for(url, 300)
    filesystem("s3").mkdir(BUCKET)
    filesystem("s3").put(str(scratch / "captures"), CAPTURES, recursive=True)
    run("prefect", "--no-prompt", "work-pool", "create", "local", "--type", "process")
    run("prefect", "--no-prompt", "deploy", "--all")
    run("flows.automations", "--silence", str(SILENCE_S))
    places = {"folder": CAPTURES, "store": str(scratch / "store"), "preset": str(scratch / "preset.yaml")}
    parameters = places | {"settle_s": 0, "max_restarts": 20}
    schedule = DeploymentScheduleCreate(schedule=IntervalSchedule(interval=timedelta(seconds=LOOK_S)))
    with get_client(sync_client=True) as client:
        training = client.read_deployment_by_name("train-subject/local")
        client.update_deployment(training.id, DeploymentUpdate(concurrency_limit=MACHINES))
        deployment = client.read_deployment_by_name("ingest-captures/local")
        client.update_deployment(deployment.id, DeploymentUpdate(parameters=parameters))
        for known in deployment.schedules:
            client.delete_deployment_schedule(deployment.id, known.id)
        client.create_deployment_schedules(deployment.id, [(schedule.schedule, True)])


def note_finished(scratch: Path, names: list[str], done: dict[str, list[str]]) -> None:
    """Add to `done` each subject that has an asset and a report on some machine or on a lost disk, with the names of
    these artifacts."""
    for name in names:
        for links in scratch.glob(f"*/subjects/{name}"):
            if name not in done and all((links / stage / file).exists() for stage, file in RESULTS.items()):
                done[name] = [f"{stage}/{Path(os.readlink(links / stage)).name}" for stage in RESULTS]


def shared_artifacts(scratch: Path) -> Counter[str]:
    """Return how often each artifact was put into the bucket, counted in the log of its server."""
    log = (scratch / "s3.log").read_text(errors="replace")
    return Counter(re.findall(rf'"PUT /{BUCKET}/shared/(\S+)\.tar HTTP/[0-9.]+" 200', log))


def wait_until_idle() -> None:
    """Wait until no run is running; call this once all results exist."""
    deadline_s = time.monotonic() + IDLE_S
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
    """Return the faults of a store. Leftovers of interrupted work are none: another machine may have resumed it."""
    from tasks.store import Store
    from tasks.verify import faults

    return faults(Store(store)).lines


def fetched(store: Path, names: list[str]) -> Path:
    """Fetch these artifacts into the store of another machine, which must not compute any; return the store."""
    from tasks.bucket import Bucket
    from tasks.shared import get_or_compute
    from tasks.store import Artifact, Store

    def refuse() -> Artifact:
        raise RuntimeError("was to be found in the bucket")

    store.mkdir()
    for name in names:
        stage, key = name.split("/")
        get_or_compute(Bucket.at(os.environ["HNERF_BUCKET"]), Store(store), stage, key, refuse)
    return store


def run(module: str, *arguments: str) -> None:
    """Run a Python module as a command; raise CalledProcessError if it fails."""
    subprocess.run([sys.executable, "-m", module, *arguments], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    sys.exit(main())

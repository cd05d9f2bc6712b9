"""A PostgreSQL of Debian's for a test, which starts empty and goes with it."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.prefect_server import free_port

BINARIES = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: int(path.parent.name))


@contextmanager
def cluster() -> Iterator[dict[str, str]]:
    """Start an empty PostgreSQL; yield the environment in which its administrator's commands run."""
    folder = Path(tempfile.mkdtemp(prefix="hnerf-postgresql-"))  # which the user postgres can reach
    as_postgres = ["setpriv", "--reuid=postgres", "--regid=postgres", "--clear-groups"] if os.getuid() == 0 else []
    if as_postgres:
        shutil.chown(folder, "postgres")
    port = str(free_port())

    def control(*arguments: str) -> None:
        command = [*as_postgres, str(BINARIES[-1] / "pg_ctl"), "-D", f"{folder}/data", "-w", *arguments]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=folder)

    control("initdb", "-o", "--auth=trust --username=postgres")
    control("start", "-l", f"{folder}/log", "-o", f"-p {port} -k {folder} -c listen_addresses=127.0.0.1")
    path = f"{BINARIES[-1]}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    try:
        yield os.environ | {"PGHOST": "127.0.0.1", "PGPORT": port, "PGUSER": "postgres", "PATH": path}
    finally:
        control("stop", "-m", "immediate")
        shutil.rmtree(folder)

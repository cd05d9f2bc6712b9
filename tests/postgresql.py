"""A PostgreSQL server (Debian's) for one test: it starts empty, and is removed afterwards."""

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
    """Start an empty PostgreSQL; yield the environment for its administrator's commands."""
    folder = Path(tempfile.mkdtemp(prefix="hnerf-postgresql-"))  # which the user postgres can read
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

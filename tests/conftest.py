"""Tensor shapes in annotations are checked; Prefect's home is a folder of this test session's own, so that tests
neither see nor touch the user's."""

import atexit
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import httpx
import pytest
from jaxtyping import install_import_hook

SHAPED = ["geometry.camera", "geometry.reach", "geometry.triangulation", "fields.compositing", "fields.encoding"]
SHAPED += ["fields.samples", "training.losses"]
install_import_hook([f"hnerf.{name}" for name in SHAPED], "beartype.beartype")

# Prefect reads its settings when it is imported.
_home = tempfile.mkdtemp(prefix="hnerf-prefect-")
atexit.register(shutil.rmtree, _home, ignore_errors=True)
os.environ |= {"PREFECT_HOME": _home, "PREFECT_SERVER_ANALYTICS_ENABLED": "false", "DO_NOT_TRACK": "1"}
os.environ.pop("HNERF_BUCKET", None)  # the user's

START_S = 120.0


@pytest.fixture(scope="session")
def prefect_api() -> Iterator[str]:
    """URL of a real Prefect server with its scheduler (the test harness of Prefect schedules nothing)."""
    from prefect.settings import PREFECT_API_URL, temporary_settings

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    url = f"http://127.0.0.1:{port}/api"
    command = ["prefect", "server", "start", "--host", "127.0.0.1", "--port", str(port), "--no-ui"]
    server = subprocess.Popen([sys.executable, "-m", *command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        _wait_for(f"{url}/health")
        with temporary_settings({PREFECT_API_URL: url}):
            yield url
    finally:
        server.terminate()
        server.wait(timeout=30)


def _wait_for(url: str) -> None:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        try:
            httpx.get(url, timeout=1.0).raise_for_status()
            return
        except httpx.HTTPError:
            time.sleep(0.2)
    pytest.fail(f"no Prefect server within {START_S:.0f} s")

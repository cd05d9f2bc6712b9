"""A Prefect server for tests, with its scheduler (Prefect's own test harness schedules nothing)."""

import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest


def free_port() -> int:
    """Return an unused port of this machine."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@contextmanager
def prefect_server(
    patience_s: float = 120.0, environment: Mapping[str, str] | None = None, folder: Path | None = None
) -> Iterator[str]:
    """Run a server; yield the URL of its API once it answers."""
    port = free_port()
    url = f"http://127.0.0.1:{port}/api"
    where = ("--host", "127.0.0.1", "--port", str(port))
    start = [sys.executable, "-m", "prefect", "server", "start", "--no-ui", *where]
    null = subprocess.DEVNULL
    with subprocess.Popen(start, env=environment, cwd=folder, stdout=null, stderr=null) as server:
        try:
            wait_for(f"{url}/health", patience_s)
            yield url
        finally:
            server.terminate()
            server.wait(timeout=60)


def wait_for(url: str, patience_s: float) -> None:
    """Wait until a server answers."""
    deadline = time.monotonic() + patience_s
    with httpx.Client(timeout=1.0) as client:  # `httpx.get` would make one each time, which takes longer than to ask
        while time.monotonic() < deadline:
            try:
                client.get(url).raise_for_status()
                return
            except httpx.HTTPError:
                time.sleep(0.2)
    pytest.fail(f"{url} does not answer within {patience_s:.0f} s")

"""Access to the Prefect server with the settings of this repository."""

import asyncio
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import httpx
import pytest
from prefect.settings import PREFECT_SERVER_API_AUTH_STRING, PREFECT_SERVER_CORS_ALLOWED_ORIGINS, temporary_settings

from flows.server_password import NAMES, environment

ROOT = Path(__file__).parents[2]
PATH = "/api/admin/version"


def ask(method: str, headers: dict[str, str], auth: tuple[str, str] | None = None) -> httpx.Response:
    """Return the response of a server app with the origins of prefect.toml and a password; no server is started."""
    from prefect.server.api.server import create_app  # takes seconds, so only the workers that need it import it

    settings = tomllib.loads((ROOT / "prefect.toml").read_text())
    origins = settings["server"]["api"]["cors_allowed_origins"]

    async def answer() -> httpx.Response:
        app = create_app(ephemeral=True, ignore_cache=True)
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://127.0.0.1:4200") as client:
            return await client.request(method, PATH, headers=headers, auth=auth)

    with temporary_settings(
        {PREFECT_SERVER_API_AUTH_STRING: "hnerf:secret", PREFECT_SERVER_CORS_ALLOWED_ORIGINS: origins}
    ):
        return asyncio.run(answer())


def test_requests_without_the_password_are_refused() -> None:
    assert ask("GET", {}).status_code == 401
    assert ask("GET", {}, ("hnerf", "guess")).status_code == 401
    assert ask("GET", {}, ("hnerf", "secret")).status_code == 200


@pytest.mark.parametrize(("origin", "allowed"), [("http://127.0.0.1:4200", True), ("http://elsewhere.example", False)])
def test_only_the_servers_own_pages_may_send_requests(origin: str, allowed: bool) -> None:
    asked = {"Origin": origin, "Access-Control-Request-Method": "POST"}
    assert ("access-control-allow-origin" in ask("OPTIONS", asked).headers) == allowed


def test_each_installation_has_its_own_password() -> None:
    one, two = ([line.partition("=") for line in environment().splitlines()] for _ in range(2))
    assert tuple(name for name, _, _ in one) == NAMES
    (password,) = {value for _, _, value in one}
    assert len(password) > 30 and password != two[0][2]


def test_an_interrupted_installation_writes_the_password_when_repeated(tmp_path: Path) -> None:
    """The shell creates the file before the program runs; with an empty file, a server would need no password."""
    (line,) = [line for line in (ROOT / "Makefile").read_text().splitlines() if "flows.server_password" in line]
    command = line.replace("$(BIN)/python", sys.executable)
    (tmp_path / ".env").touch()
    texts = []
    for _ in range(2):
        subprocess.run(["sh", "-c", command], cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True)
        texts.append((tmp_path / ".env").read_text())
    assert texts[0] == texts[1] and texts[0].startswith(NAMES[0])

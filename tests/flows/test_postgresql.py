"""The commands for PostgreSQL in docs/operations.md, on a temporary server (only in `make soak`)."""

import subprocess
from pathlib import Path

import pytest

from tests.postgresql import BINARIES, cluster
from tests.prefect_server import prefect_server

PATIENCE_S = 300.0

pytestmark = [pytest.mark.soak, pytest.mark.skipif(not BINARIES, reason="Debian's postgresql is not installed")]


def shell(command: str, environment: dict[str, str], folder: Path) -> str:
    done = subprocess.run(command, shell=True, env=environment, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    return done.stdout


def serve(environment: dict[str, str], folder: Path, commands: list[str]) -> str:
    """Run commands with a Prefect server on the database; return their output."""
    with prefect_server(PATIENCE_S, environment, folder) as url:
        return "".join(shell(command, environment | {"PREFECT_API_URL": url}, folder) for command in commands)


def test_set_up_upgrade_backup_and_restore(tmp_path: Path) -> None:
    """After the restore, a work pool made before the backup exists, and one made later does not."""
    with cluster() as environment:
        environment |= {"PREFECT_HOME": str(tmp_path), "PREFECT_SERVER_ANALYTICS_ENABLED": "false"}
        shell("createuser hnerf && createdb hnerf --owner hnerf", environment, tmp_path)
        url = f"postgresql+asyncpg://hnerf:PASSWORD@localhost:{environment['PGPORT']}/hnerf"
        (tmp_path / ".env").write_text(f"PREFECT_SERVER_DATABASE_CONNECTION_URL={url}\n")
        shell("prefect server database upgrade --yes", environment, tmp_path)
        assert "alembic" in shell("psql --tuples-only --command '\\dt' hnerf", environment, tmp_path)
        pool = "prefect --no-prompt work-pool create {} --type process"
        serve(environment, tmp_path, [pool.format("before")])
        shell("pg_dump --format=custom hnerf > prefect.dump", environment, tmp_path)
        serve(environment, tmp_path, [pool.format("after")])
        restore = "dropdb hnerf && createdb hnerf --owner hnerf && pg_restore --dbname=hnerf < prefect.dump"
        shell(restore, environment, tmp_path)
        shell("prefect server database upgrade --yes", environment, tmp_path)
        names = serve(environment, tmp_path, ["prefect work-pool ls"])
        assert "before" in names and "after" not in names

"""Units of systemd for server and worker, as services of a user: python -m flows.systemd_units FOLDER."""

import argparse
import sys
from pathlib import Path

from hnerf.errors import InputError

ROOT = Path(__file__).parents[1]


def units(root: Path, program: Path) -> dict[str, str]:
    """Return the text of each unit, by file name, for a checkout at `root` and Prefect's program. The worker ends with
    all its runs; what they have finished is in the store."""
    folder, prefect = _escaped(root), _escaped(program)
    server = f'"{prefect}" server start'
    worker = f'"{prefect}" worker start --pool local --type process --limit 5'
    return {
        "hnerf-server.service": _unit("H-NeRF: Prefect server", "network.target", folder, server),
        "hnerf-worker.service": _unit("H-NeRF: worker", "hnerf-server.service", folder, worker),
    }


def _unit(what: str, after: str, folder: str, command: str) -> str:
    wants = f"Wants={after}\n" if after.endswith(".service") else ""
    return f"""[Unit]
Description={what}
After={after}
{wants}StartLimitIntervalSec=0

[Service]
WorkingDirectory={folder}
ExecStart={command}
Restart=always
RestartSec=10
TimeoutStopSec=90
OOMPolicy=continue

[Install]
WantedBy=default.target
"""


def _escaped(path: Path) -> str:
    """Return a path in which systemd expands nothing. Raises InputError if the path cannot be written that way."""
    if '"' in str(path) or "\\" in str(path):
        raise InputError(f'{path}: systemd takes no path with " or \\; move the checkout')
    return str(path).replace("%", "%%")


def main(argv: list[str] | None = None) -> None:
    """Write the units of this checkout into the folder that the command line names."""
    parser = argparse.ArgumentParser(prog="python -m flows.systemd_units", description=__doc__)
    parser.add_argument("folder", type=Path, help="where systemd looks, like ~/.config/systemd/user")
    folder = parser.parse_args(argv).folder
    if not folder.is_dir():
        parser.exit(2, f"{folder}: no such folder; make it first\n")
    prefect = Path(sys.executable).with_name("prefect")
    if not prefect.is_file():
        parser.exit(2, f"{prefect}: no such program; run `make install`, and this with .venv/bin/python\n")
    try:
        texts = units(ROOT, prefect)
    except InputError as error:
        parser.exit(2, f"{error}\n")
    for name, text in texts.items():
        (folder / name).write_text(text)


if __name__ == "__main__":
    main()

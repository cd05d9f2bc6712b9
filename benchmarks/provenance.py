"""Where figures come from: the machine, the commit, the date; and how they are written down."""

import json
import os
import platform
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
SHARED = ROOT.parent / "shared"


def provenance() -> dict[str, Any]:
    """What stands at the head of every file of results."""
    return {"machine": _machine(), "commit": _commit(), "date": datetime.now(UTC).date().isoformat()}


def sentence(result: dict[str, Any]) -> str:
    """The same as one line of Markdown."""
    m = result["machine"]
    return (
        f"{m['cpu']}, {m['cores']} cores, {m['gpu'] or 'no GPU'}, torch {m['torch']}, Python {m['python']}; "
        f"commit {result['commit']}; {result['date']}."
    )


def write_result(name: str, result: dict[str, Any], markdown: str) -> None:
    """Write `benchmarks/results/NAME.json` and `.md`."""
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")
    (RESULTS / f"{name}.md").write_text(markdown)


def table(rows: list[list[str]]) -> list[str]:
    """Lines of a Markdown table; the first row is its head."""
    body = ["| " + " | ".join(row) + " |" for row in rows]
    return [body[0], "|" + "---|" * len(rows[0]), *body[1:]]


def _machine() -> dict[str, Any]:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def _commit() -> str:
    """The checkout's commit, marked where files differ from it."""
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=12"]
    described = subprocess.run(command, capture_output=True, text=True)
    return described.stdout.strip() or "not committed"

"""Where figures come from: the machine, the commit, the date; and how they are written down."""

import json
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hnerf.study.machine import in_words, machine
from hnerf.tables import head, line

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
SHARED = ROOT.parent / "shared"


def provenance() -> dict[str, Any]:
    """What stands at the head of every file of results."""
    return {"machine": machine(), "commit": _commit(), "date": datetime.now(UTC).date().isoformat()}


def sentence(result: dict[str, Any]) -> str:
    """The same as one line of Markdown."""
    return f"{in_words(result['machine'])}; commit {result['commit']}; {result['date']}."


def write_result(name: str, result: dict[str, Any], markdown: str) -> None:
    """Write `benchmarks/results/NAME.json` and `.md`."""
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")
    (RESULTS / f"{name}.md").write_text(markdown)


def table(rows: list[list[str]]) -> list[str]:
    """Lines of a Markdown table; the first row is its head."""
    return [*head(rows[0]), *map(line, rows[1:])]


def _commit() -> str:
    """The checkout's commit, marked where files other than results differ from it."""

    def git(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True)

    commit = git("rev-parse", "--short=12", "HEAD").stdout.strip()
    changed = git("diff", "--quiet", "HEAD", "--", ".", ":!benchmarks/results").returncode
    return f"{commit}-dirty" if commit and changed else commit or "not committed"

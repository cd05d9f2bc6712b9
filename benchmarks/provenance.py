"""Where figures come from: the machine, the commit, the date; and how they are written down."""

import json
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn

import hnerf
from hnerf.study.machine import describe_machine, machine
from hnerf.tables import head, line

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
SHARED = ROOT.parent / "shared"
REFUSED = 2


def provenance() -> dict[str, Any]:
    """What stands at the head of every file of results; a program's first call, as it ends the program as
    `clean_commit` does, and where the code that would be measured is another checkout's."""
    package = Path(hnerf.__file__).resolve().parent
    if package.parent != ROOT:
        _refuse(f"hnerf is imported from {package}; give PYTHONPATH={ROOT}")
    return {"machine": machine(), "commit": clean_commit(ROOT), "date": datetime.now(UTC).date().isoformat()}


def sentence(result: dict[str, Any]) -> str:
    """The same as one line of Markdown."""
    return f"{describe_machine(result['machine'])}; commit {result['commit']}; {result['date']}."


def write_result(name: str, result: dict[str, Any], markdown: str) -> None:
    """Write `benchmarks/results/NAME.json` and `.md`, unless the checkout was changed since the program began."""
    clean_commit(ROOT)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")
    (RESULTS / f"{name}.md").write_text(markdown)


def table(rows: list[list[str]]) -> list[str]:
    """Lines of a Markdown table; the first row is its head."""
    return [*head(rows[0]), *map(line, rows[1:])]


def clean_commit(root: Path) -> str:
    """The checkout's commit; ends the program with one line and exit code 2 where there is none, or where files other
    than results differ from it or are unknown to it."""

    def git(*arguments: str) -> str:
        return subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True).stdout

    commit = git("rev-parse", "--short=12", "HEAD").strip()
    if not commit:
        _refuse(f"{root} has no commit; results are made from a git checkout")
    changed = [line[3:] for line in git("status", "--porcelain", "--", ".", ":!benchmarks/results").splitlines()]
    if changed:
        more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
        _refuse(f"{changed[0]}{more} not as in commit {commit}; commit first: results are made from clean checkouts")
    return commit


def _refuse(why: str) -> NoReturn:
    print(f"{Path(sys.argv[0]).name}: {why}", file=sys.stderr)
    raise SystemExit(REFUSED)

"""What the programs share: their arguments, the provenance of results (machine, commit and date), and the writing of
results."""

import argparse
import json
import logging
import subprocess
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn

import hnerf
from hnerf.study.machine import describe_machine, machine
from hnerf.tables import table as table  # the programs take it from here

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
SHARED = ROOT.parent / "shared"
REFUSED = 2


def arguments(doc: str | None) -> argparse.ArgumentParser:
    """Return the argument parser of a program, which shows its docstring."""
    return argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)


def store_and_captures(doc: str | None, captures: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments STORE and CAPTURE ... of a program. captures: the default."""
    parser = arguments(doc)
    parser.add_argument("store", type=Path)
    parser.add_argument("captures", nargs="*", default=captures, metavar="CAPTURE")
    return parser.parse_args()


def log_progress() -> None:
    """Show the package's log, with the time."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S")


def provenance() -> dict[str, Any]:
    """Return the provenance that heads every file of results. A program calls this first. Like `clean_commit`, it ends
    the program if results could not be attributed, and also if hnerf is imported from another checkout."""
    package = Path(hnerf.__file__).resolve().parent
    if package.parent != ROOT:
        _refuse(f"hnerf is imported from {package}; give PYTHONPATH={ROOT}")
    return {"machine": machine(), "commit": clean_commit(ROOT), "date": datetime.now(UTC).date().isoformat()}


def provenance_line(result: dict[str, Any]) -> str:
    """Format the provenance as one line of Markdown."""
    return f"{describe_machine(result['machine'])}; commit {result['commit']}; {result['date']}."


def write_result(name: str, result: dict[str, Any], markdown: str) -> None:
    """Print the Markdown and write `benchmarks/results/NAME.json` and `.md`, unless the checkout has changed since the
    program started."""
    print(markdown)
    clean_commit(ROOT)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")
    (RESULTS / f"{name}.md").write_text(markdown)


def clean_commit(root: Path) -> str:
    """Return the checkout's commit. If there is none, or if files other than results differ from it or are untracked,
    end the program with one line and exit code 2."""

    def git(*arguments: str) -> str:
        return subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True).stdout

    commit = git("rev-parse", "--short=12", "HEAD").strip()
    if not commit:
        _refuse(f"{root} has no commit; results are made from a git checkout")
    changed = [line[3:] for line in git("status", "--porcelain", "--", ".", ":!benchmarks/results").splitlines()]
    if changed:
        more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
        _refuse(f"uncommitted changes in {changed[0]}{more} since {commit}; results are made from clean checkouts")
    return commit


def _refuse(why: str) -> NoReturn:
    print(f"{Path(sys.argv[0]).name}: {why}", file=sys.stderr)
    raise SystemExit(REFUSED)

"""Freshness of results: digests of the code that makes them, and a record of every result.

`benchmarks/results/provenance.json` holds, by the result's name, the digest of the code that made it, the commit, date,
machine, the machine's mean load during the run, seconds, and the SHA-256 of each of its files. `provenance.md` shows
it.
"""

import ast
import hashlib
import json
import re
import subprocess
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from provenance import table
from registry import Result

from hnerf.files import replace_text
from hnerf.study.machine import describe_machine

MODULE = re.compile(r"[a-z]\w*(\.\w+)+")  # modules that are started by name, like the ranks of a training
STAGE = re.compile(r'@stage\("([\w-]+)", version="(\d+)"')
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
Records = dict[str, dict[str, Any]]


def code_digest(root: Path, result: Result) -> str:
    """Return the SHA-256 of the command, the modules of this checkout that its program imports or starts, and the
    settings that it reads. Comments, docstrings and formatting do not count."""
    parts = [" ".join(result.command)]
    parts += [f"{path.relative_to(root)}\n{_code(path.read_text())[0]}" for path in sources(root, result)]
    patterns = list(result.configs)
    for pattern in patterns:
        found = sorted((root / "configs").glob(f"{pattern}.yaml"))
        assert found, f"{result.name}: no configs/{pattern}.yaml"
        trees = {path: yaml.safe_load(path.read_text()) for path in found}
        parts += [f"{path.relative_to(root)}\n{json.dumps(tree)}" for path, tree in trees.items()]
        patterns += [tree["based_on"] for tree in trees.values() if "based_on" in tree]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def sources(root: Path, result: Result) -> list[Path]:
    """Return the program and all modules of the checkout that it imports or names, directly or indirectly, sorted."""
    found: set[Path] = set()
    waiting = [root / "benchmarks" / result.command[0]]
    waiting += [path for module in result.runs for path in _files(root, module)]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            bases = [root, path.parent] if path.parent.name == "benchmarks" else [root]  # programs import neighbours
            named = _code(path.read_text())[1]
            waiting += [file for module in named for base in bases for file in _files(base, module)]
    return sorted(found)


def stale_reason(root: Path, result: Result, records: Records) -> str | None:
    """Return why a result is not fresh; None if it is."""
    record = records.get(result.name)
    if record is None:
        return "not recorded"
    if record["digest"] != code_digest(root, result):
        return "its code has changed"
    digests = file_digests(root, result)
    changed = sorted({name for name, _ in digests.items() ^ record["files"].items()})
    return f"{changed[0]} has changed since it was made" if changed else None


def raised_stages(root: Path, result: Result, commit: str) -> str:
    """Return the stages that the result runs and whose version differs between a commit and HEAD, with both versions:
    of all stages, only they, and those that read what they write, yield something else by the same settings. "none" if
    no version differs, "-" if the result runs no stage, "unknown" if a shallow clone lacks the commit."""
    files = [str(path.relative_to(root)) for path in sources(root, result)]
    was, now = (_stage_versions(root, at, files) for at in (commit, "HEAD"))
    if was is None or now is None:
        return "unknown"
    raised = [f"{name} {was.get(name, '-')} → {now[name]}" for name in sorted(now) if now[name] != was.get(name)]
    return ", ".join(raised) or ("none" if now else "-")


def file_digests(root: Path, result: Result) -> dict[str, str]:
    """Return the SHA-256 of each existing file of the result."""
    return {
        str(path.relative_to(root / "benchmarks" / "results")): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in result_files(root, result)
    }


def result_files(root: Path, result: Result) -> list[Path]:
    """Return the existing files of the result, sorted."""
    return sorted({path for pattern in result.files for path in (root / "benchmarks" / "results").glob(pattern)})


def load_records(root: Path) -> Records:
    """Return the records by name of the result."""
    path = root / "benchmarks" / "results" / "provenance.json"
    return json.loads(path.read_text()) if path.exists() else {}


def save_record(root: Path, name: str, record: dict[str, Any]) -> None:
    """Add or replace a record, and rewrite the table of all records."""
    records = load_records(root) | {name: record}
    path = root / "benchmarks" / "results" / "provenance.json"
    replace_text(path, json.dumps(dict(sorted(records.items())), indent=1) + "\n")
    rows = [["result", "seconds", "commit", "date", "machine", "load"]]
    for made, r in sorted(records.items()):
        rows.append(
            [made, shown_seconds(r), r["commit"], r["date"], describe_machine(r["machine"]), f"{r['load']:.1f}"]
        )
    lines = ["# Where results come from", "", "Made by `benchmarks/all.py`; see docs/results.md.", "", *table(rows), ""]
    replace_text(path.with_suffix(".md"), "\n".join(lines))


def shown_seconds(record: dict[str, Any]) -> str:
    """Format the seconds that the result took when it was last made from scratch."""
    return "-" if record["seconds"] is None else f"{record['seconds']:.0f}"


def _stage_versions(root: Path, commit: str, files: list[str]) -> dict[str, str] | None:
    """Return the version of each stage that these files declare at a commit, by its name; None without the commit."""
    command = ["git", "-C", str(root), "grep", "--no-color", "-h", "@stage", commit, "--", *files]
    ended = subprocess.run(command, capture_output=True, text=True)
    return dict(STAGE.findall(ended.stdout)) if ended.returncode <= 1 else None  # 1: no line matches


def _files(base: Path, module: str) -> Iterator[Path]:
    """Yield the files of a module and of its packages, as far as they exist in the folder."""
    path = base
    for name in module.split("."):
        path /= name
        yield from (file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file())
        if not path.is_dir():
            return


@cache
def _code(text: str) -> tuple[str, tuple[str, ...]]:
    """Return a module's code without comments and docstrings, and the names of all modules that it may import or
    start."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node) is not None:
            node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(tree), tuple(dict.fromkeys(_named(ast.walk(tree))))


def _named(nodes: Iterable[ast.AST]) -> Iterator[str]:
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and MODULE.fullmatch(node.value):
            yield node.value

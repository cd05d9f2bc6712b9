"""Make again every committed result that the present code would change, and record how long each took.

usage: python benchmarks/all.py [NAME ...] [--store STORE] [--jobs 1|2] [--list]

NAME is a result's name in benchmarks/registry.py or a pattern of names, such as "stability/*"; by default all results.
Results that are fresh are skipped, and so are those whose capture is not in `../shared/data` beside this checkout, or
that need a GPU where there is none. Ends with exit code 2 if the checkout has uncommitted changes. After an
interruption, repeat the same command: finished results are fresh, and an unfinished one finds its finished trainings in
STORE. A result that fails is reported at the end, with exit code 1, and does not stop the others. `--list` shows the
state of each result, and the stages that have yielded something else since; it makes none.
"""

import fnmatch
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import torch
from freshness import (
    code_digest,
    file_digests,
    load_records,
    raised_stages,
    result_files,
    save_record,
    shown_seconds,
    stale_reason,
)
from provenance import ROOT, arguments, clean_commit, table
from registry import REGISTRY, Result
from stopwatch import Stopwatch

from hnerf.processes import end_with_parent
from hnerf.study.machine import machine

FAILED = 1
POLL_S = 0.2  # interval between checks of running programs


def main(argv: list[str] | None = None) -> int:
    """Make or list the chosen results; return 1 if any could not be made."""
    parser = arguments(__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--store", type=Path, default=ROOT / "store", help="folder of trainings and logs")
    parser.add_argument("--jobs", type=int, choices=(1, 2), default=1, help="programs side by side, one thread each")
    parser.add_argument("--list", action="store_true", help="show which results are fresh, and make none")
    options = parser.parse_args(argv)
    unknown = [name for name in options.names if not fnmatch.filter([r.name for r in REGISTRY], name)]
    if unknown:
        parser.error(f"{unknown[0]}: no such result; there are {', '.join(r.name for r in REGISTRY)}")
    chosen = [r for r in REGISTRY if not options.names or any(fnmatch.fnmatch(r.name, n) for n in options.names)]
    if options.list:
        print("\n".join(listing(ROOT, chosen)))
        return 0
    return make(ROOT, chosen, options.store.resolve(), options.jobs)


def listing(root: Path, results: Sequence[Result]) -> list[str]:
    """Return a table of results: whether each is fresh or why not, which of its stages have had their version raised
    since, and what is recorded about it."""
    records = load_records(root)
    rows = [["result", "state", "stages raised since", "seconds", "code", "commit"]]
    for result in results:
        why, record, known = stale_reason(root, result, records), records.get(result.name), ["-"] * 4
        if record:
            raised = raised_stages(root, result, record["commit"])
            known = [raised, shown_seconds(record), record["digest"][:12], record["commit"]]
        rows.append([result.name, f"stale: {why}" if why else "fresh", *known])
    return table(rows)


def make(root: Path, results: Sequence[Result], store: Path, jobs: int) -> int:
    """Make the results that are not fresh, in order, as cores become free; return 1 if any failed."""
    clean_commit(root)
    waiting, running, failed = [], list[Job](), dict[str, str]()
    for result in results:
        passed_over = reason_to_skip(root, result, jobs)
        if passed_over:
            print(f"{result.name}: {passed_over}", flush=True)
        else:
            waiting.append(result)
    try:
        while waiting or running:
            free = jobs - sum(job.result.threads for job in running)
            ready = next((result for result in waiting if result.threads <= free), None)
            if ready:
                waiting.remove(ready)
                running.append(Job(root, ready, store))
                continue
            time.sleep(POLL_S)
            for job in [job for job in running if not job.running()]:
                running.remove(job)
                fault = job.finish()
                if fault:
                    failed[job.result.name] = fault
                print(f"{job.result.name}: {fault or f'{job.watch.seconds:.0f} s'}", flush=True)
    finally:  # after Ctrl-C, or if the checkout has changed meanwhile
        for job in running:
            job.stop()
    for name, fault in failed.items():
        print(f"failed: {name}: {fault}", file=sys.stderr)
    return FAILED if failed else 0


def reason_to_skip(root: Path, result: Result, jobs: int) -> str | None:
    """Return why a result is skipped; None if it must be made."""
    if stale_reason(root, result, load_records(root)) is None:
        return "fresh"
    absent = [name for name in result.captures if not (root.parent / "shared" / "data" / name).is_dir()]
    if absent:
        return f"left out: no ../shared/data/{absent[0]}"
    if result.gpu and not torch.cuda.is_available():
        return "left out: needs a GPU"
    return "left out: needs both cores; give --jobs 2" if result.threads > jobs else None


class Job:
    """A running program that makes one result, with the commit and code digest from which it started."""

    def __init__(self, root: Path, result: Result, store: Path) -> None:
        self.root, self.result = root, result
        self.commit, self.digest = clean_commit(root), code_digest(root, result)
        self.loads: list[float] = []
        self.before = {path: path.stat().st_mtime_ns for path in result_files(root, result)}
        flat, used = result.name.replace("/", "-"), " ".join(result.command)
        new, logs = store / f"{flat}-{self.digest[:12]}", store / "logs"
        for folder in (logs, new) if "{new}" in used else (logs,):
            folder.mkdir(parents=True, exist_ok=True)
        state = new / "seconds.json" if "{new}" in used else logs / f"{flat}.json"
        if "{store}" not in used and "{new}" not in used:
            state.unlink(missing_ok=True)  # there is nothing to resume from
        self.store = new if "{new}" in used else store
        self.log, self.watch = logs / f"{flat}.log", Stopwatch(state, self.digest)
        program, *arguments = (argument.format(store=store, new=new) for argument in result.command)
        threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(result.threads))
        print(f"{result.name}: under way, {self.log}", flush=True)
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [sys.executable, str(root / "benchmarks" / program), *arguments],
                cwd=root,
                env=os.environ | threads | {"PYTHONPATH": str(root)},  # this checkout before installed packages
                stdout=log,
                stderr=subprocess.STDOUT,
                preexec_fn=partial(end_with_parent, signal.SIGTERM, os.getpid()),
            )

    def running(self) -> bool:
        """Return whether the program is still running."""
        if self.watch.tick() or not self.loads:
            self.loads.append(os.getloadavg()[0])
        return self.process.poll() is None

    def stop(self) -> None:
        """End the program and all that it has started; its time counts when the same work is resumed."""
        self.process.terminate()
        self.process.wait()
        self.watch.save(done=False)

    def finish(self) -> str | None:
        """Record the result of a program that has ended; if there is none, return why."""
        fault = self._fault()
        self.watch.save(done=fault is None)
        if fault:
            return fault
        for path in result_files(self.root, self.result):
            if path not in self._written():
                path.unlink()  # left by an earlier run with more files
        known = load_records(self.root).get(self.result.name, {"seconds": None})
        record = {
            "digest": self.digest,
            "commit": self.commit,
            "date": datetime.now(UTC).date().isoformat(),
            "machine": machine() | {"threads": self.result.threads},
            "load": sum(self.loads) / len(self.loads),
            "seconds": known["seconds"] if self._reused() or not self.watch.is_complete else self.watch.seconds,
            "files": file_digests(self.root, self.result),
        }
        save_record(self.root, self.result.name, record)
        return None

    def _reused(self) -> bool:
        """Return whether the program used a training that another result, or a command, had left in the store. Its
        folder is then older than this run, but its record, which is touched at each use, is newer."""
        records = (self.store / "training").glob("*.json")
        return any(
            record.with_suffix("").stat().st_mtime < self.watch.began < record.stat().st_mtime
            for record in records
            if record.with_suffix("").exists()
        )

    def _fault(self) -> str | None:
        if self.process.returncode:
            lines = self.log.read_text(errors="replace").split("\n")
            last = next((line for line in reversed(lines) if line.strip()), "no output")
            return f"exit code {self.process.returncode}: {last.strip()} ({self.log})"
        if code_digest(self.root, self.result) != self.digest:
            return "its code was changed while it ran"
        return None if self._written() else f"wrote no file named {' or '.join(self.result.files)}"

    def _written(self) -> list[Path]:
        found = result_files(self.root, self.result)
        return [path for path in found if path.stat().st_mtime_ns != self.before.get(path)]


if __name__ == "__main__":
    sys.exit(main())

"""Stopwatch that measures the time of a result across interruptions."""

import json
import time
from pathlib import Path
from typing import Any

SAVE_S = 10.0


class Stopwatch:
    """A stopwatch that runs from its creation, and continues from the file of an interrupted run of the same code.

    is_complete: whether `seconds` covers all the work. It does not if, according to the file, an earlier run may have
    left something to reuse, because it had other code or had ended. began: when the first of the runs began, in seconds
    since the epoch.
    """

    def __init__(self, path: Path, digest: str) -> None:
        found: dict[str, Any] = {"digest": digest, "seconds": 0.0, "whole": True, "done": False, "began": time.time()}
        if path.exists():
            found = json.loads(path.read_text())
        goes_on = found["digest"] == digest and not found["done"] and "began" in found
        self.path, self.digest = path, digest
        self.is_complete = goes_on and found["whole"]
        self.earlier_s = found["seconds"] if goes_on else 0.0
        self.began: float = found["began"] if goes_on else time.time()
        self.started_s = self.saved_s = time.monotonic()

    @property
    def seconds(self) -> float:
        """Return the seconds so far."""
        return self.earlier_s + time.monotonic() - self.started_s

    def tick(self) -> bool:
        """Save every few seconds, in case this process is killed; return whether it saved."""
        due = time.monotonic() - self.saved_s > SAVE_S
        if due:
            self.save(done=False)
        return due

    def save(self, done: bool) -> None:
        """Write the file."""
        self.saved_s = time.monotonic()
        state = {"digest": self.digest, "seconds": self.seconds, "whole": self.is_complete, "done": done}
        self.path.write_text(json.dumps(state | {"began": self.began}))

"""How long a result takes, over interruptions."""

import json
import time
from pathlib import Path
from typing import Any

SAVE_S = 10.0


class Stopwatch:
    """Runs from when it is made, and goes on from where an interrupted run of the same code left its file.

    `whole` is whether `seconds` are of all the work: not where a file says that an earlier run of other code, or one
    that ended, has left trainings to be found.
    """

    def __init__(self, path: Path, digest: str) -> None:
        found: dict[str, Any] = {"digest": digest, "seconds": 0.0, "whole": True, "done": False}
        if path.exists():
            found = json.loads(path.read_text())
        goes_on = found["digest"] == digest and not found["done"]
        self.path, self.digest = path, digest
        self.whole = goes_on and found["whole"]
        self.earlier_s = found["seconds"] if goes_on else 0.0
        self.started_s = self.saved_s = time.monotonic()

    @property
    def seconds(self) -> float:
        """So far."""
        return self.earlier_s + time.monotonic() - self.started_s

    def tick(self) -> bool:
        """Save now and then, for when this process is killed; returns whether it did."""
        due = time.monotonic() - self.saved_s > SAVE_S
        if due:
            self.save(done=False)
        return due

    def save(self, done: bool) -> None:
        """Write the file."""
        self.saved_s = time.monotonic()
        state = {"digest": self.digest, "seconds": self.seconds, "whole": self.whole, "done": done}
        self.path.write_text(json.dumps(state))

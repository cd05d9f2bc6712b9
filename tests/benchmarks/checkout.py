"""A fake checkout whose programs write a line, and results that they make."""

import subprocess
from pathlib import Path

from registry import Result

PROGRAM = """
import sys
from pathlib import Path

from hnerf.near import NUMBER

name, store = sys.argv[1:]
with (Path(store) / "calls").open("a") as calls:
    calls.write(name + chr(10))
results = Path(__file__).parent / "results"
results.mkdir(exist_ok=True)
(results / f"{name}.md").write_text(f"{NUMBER}" + chr(10))
"""


class Checkout:
    """A git repository in a folder, with a program, a package of two modules, and settings."""

    def __init__(self, root: Path) -> None:
        self.root, self.store = root / "checkout", root / "store"
        self.store.mkdir(parents=True)
        self.root.mkdir()
        self.git("init", "--quiet")
        self.write("benchmarks/program.py", PROGRAM)
        self.write("benchmarks/neighbour.py", "HELPER = 1\n")
        self.write("hnerf/__init__.py", "")
        self.write("hnerf/near.py", "from hnerf import far\nNUMBER = far.NUMBER\n")
        self.write("hnerf/far.py", "NUMBER = 1\n")
        self.write("hnerf/unused.py", "NUMBER = 1\n")
        self.write("configs/fast.yaml", "steps: 10\n")
        self.commit()

    def write(self, name: str, text: str) -> None:
        """Write a file."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def commit(self) -> None:
        """Commit everything."""
        self.git("add", "--all")
        who = ("-c", "user.name=a", "-c", "user.email=a@example.org")
        self.git(*who, "commit", "--quiet", "--no-gpg-sign", "--message", "change")

    def git(self, *arguments: str) -> None:
        """Run git."""
        subprocess.run(["git", "-C", str(self.root), *arguments], check=True)

    def calls(self) -> list[str]:
        """Return the names of the results that programs were called for, in order."""
        path = self.store / "calls"
        return path.read_text().split() if path.exists() else []

    def text(self, name: str) -> str:
        """Return what a program wrote."""
        return (self.root / "benchmarks" / "results" / f"{name}.md").read_text()


def made(name: str, program: str = "program.py", **more: object) -> Result:
    """Return a result NAME.md of a program that is given the name and the store."""
    return Result(name, (program, name, "{store}"), (f"{name}.md",), **more)

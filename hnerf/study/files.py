"""Tables that are written anew while somebody may be reading them."""

import os
from pathlib import Path


def replace_text(path: Path, text: str) -> None:
    """Write beside and rename."""
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    beside.write_text(text)
    os.replace(beside, path)

"""Tables that are written anew while somebody may be reading them, and shown where there are no files."""

import base64
import os
import re
from pathlib import Path


def replace_text(path: Path, text: str) -> None:
    """Write beside and rename."""
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    beside.write_text(text)
    os.replace(beside, path)


def picture(name: str) -> str:
    """Markdown that shows a file, whose name may hold spaces and parentheses."""
    return f"![{name}](<{name}>)"


def with_pictures(table: Path) -> str:
    """A Markdown file's text, PNG files beside it that `picture` shows as data URIs. OSError where one is missing."""
    return re.sub(r"(?<=\]\()<([^>]+\.png)>", lambda shown: _data_uri(table.with_name(shown[1])), table.read_text())


def _data_uri(path: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"

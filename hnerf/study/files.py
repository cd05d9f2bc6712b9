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


def with_pictures(table: Path) -> str:
    """A Markdown file's text, with the PNG files beside it that it shows as data URIs. OSError where one is missing."""
    return re.sub(r"(?<=\]\()[^)]+\.png", lambda name: _data_uri(table.with_name(name[0])), table.read_text())


def _data_uri(picture: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(picture.read_bytes()).decode()}"

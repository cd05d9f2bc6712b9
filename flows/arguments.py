"""Types of command-line arguments, and of parameters of flows."""

import argparse
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from pydantic import Field

from tasks.source import path_or_url

MAX_COUNT = 999_999  # image names have six digits
# The server refuses an empty one, as from a variable that is not set, which would be the checkout.
StoreFolder = Annotated[Path, Field(json_schema_extra={"minLength": 1})]


def path(text: str) -> Path:
    """Return a path. An empty one, as from a variable that is not set, would be the current folder. One that is not
    UTF-8 crashes libraries."""
    if not text:
        raise argparse.ArgumentTypeError("is empty; give a path")
    whole = os.path.abspath(text)
    if (shown := os.fsencode(whole).decode(errors="replace")) != whole:
        raise argparse.ArgumentTypeError(f"{shown} is not UTF-8; rename it")
    return Path(text)


def path_or_bucket_url(text: str) -> Path | str:
    """Return the URL of something in a bucket, or a path as `path` does."""
    given = path_or_url(text)
    return path(str(given)) if isinstance(given, Path) else given


def number(kind: type[float], low: float, high: float) -> Callable[[str], float]:
    """Return an option type that takes numbers in a range, int or float, and refuses others, including NaN."""

    def read(text: str) -> float:
        with suppress(ValueError):
            if low <= (value := kind(text)) <= high:
                return value
        raise argparse.ArgumentTypeError(f"give {'a whole number' if kind is int else 'a number'} from {low} to {high}")

    return read

"""Markdown tables: lines, and figures formatted as cells."""

from collections.abc import Mapping, Sequence
from typing import Any


def head(titles: Sequence[str]) -> list[str]:
    """Return the first two lines of a table: its titles and the rule below them."""
    return [line(titles), "|" + "---|" * len(titles)]


def line(cells: Sequence[str]) -> str:
    """Return one row of a table."""
    return f"| {' | '.join(cells)} |"


def shown(value: float | None, form: str) -> str:
    """Return a figure in the format `form`, or "-" if there is none."""
    return "-" if value is None else form.format(value)


def pick(tree: Mapping[str, Any], key: str) -> Any:
    """Return a value deep in a tree by its path, such as "geometry.iou"; None if a branch on the way is missing or
    null."""
    value: Any = tree
    for part in key.split("."):
        value = (value or {}).get(part)
    return value

"""Markdown tables, and figures formatted as cells."""

from collections.abc import Mapping, Sequence
from typing import Any


def table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table, whose first row is its titles. A shorter row ends with empty cells; "|" in a cell,
    as in the message of an error, becomes "/"."""
    full = [[cell.replace("|", "/") for cell in row] + [""] * (len(rows[0]) - len(row)) for row in rows]
    titles, *lines = (f"| {' | '.join(cells)} |" for cells in full)
    return [titles, "|" + "---|" * len(rows[0]), *lines]


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

"""Lines of Markdown tables, and figures as their cells."""

from collections.abc import Mapping, Sequence
from typing import Any


def head(titles: Sequence[str]) -> list[str]:
    """A table's first two lines."""
    return [line(titles), "|" + "---|" * len(titles)]


def line(cells: Sequence[str]) -> str:
    """A row."""
    return f"| {' | '.join(cells)} |"


def shown(value: float | None, form: str) -> str:
    """A figure, "-" where there is none."""
    return "-" if value is None else form.format(value)


def pick(tree: Mapping[str, Any], key: str) -> Any:
    """A value deep in a tree, like "geometry.iou"; None where a branch on the way is missing or null."""
    value: Any = tree
    for part in key.split("."):
        value = (value or {}).get(part)
    return value

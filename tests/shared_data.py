"""Where the shared captures lie, if this checkout has them beside it."""

from pathlib import Path

import pytest

SHARED_DATA = Path(__file__).parent.parent.parent / "shared" / "data"


def shared_capture(name: str) -> Path:
    """The folder of a shared capture; skips the test where it is absent."""
    path = SHARED_DATA / name
    if not path.exists():
        pytest.skip(f"shared capture {name} is not beside this checkout")
    return path

"""The shared captures, if they are next to this checkout."""

from pathlib import Path

import pytest

SHARED_DATA = Path(__file__).parent.parent.parent / "shared" / "data"


def shared_capture(name: str) -> Path:
    """Return the folder of a shared capture; skip the test if it is absent."""
    path = SHARED_DATA / name
    if not path.exists():
        pytest.skip(f"shared capture {name} is not beside this checkout")
    return path

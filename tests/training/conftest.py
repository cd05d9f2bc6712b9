import pytest

from tests.training.scene import SHRUNK_CONSTANTS


@pytest.fixture
def any_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    """Accept any surface and use coarse checks; tests of the surface check set their own threshold."""
    for module, name, value in SHRUNK_CONSTANTS:
        monkeypatch.setattr(module, name, value)

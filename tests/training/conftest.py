import pytest

from tests.training.scene import SHRUNK_CONSTANTS


@pytest.fixture
def any_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    """Accept any surface, and look at it coarsely; tests of the check set their own threshold."""
    for module, name, value in SHRUNK_CONSTANTS:
        monkeypatch.setattr(module, name, value)

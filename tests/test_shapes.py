"""The tests check shapes in annotations (tests/conftest.py)."""

import pytest
import torch
from jaxtyping import TypeCheckError

from hnerf.fields.compositing import composite


def test_a_wrong_shape_is_refused() -> None:
    """Pass three weights per ray, but four values."""
    with pytest.raises(TypeCheckError, match="composite"):
        composite(torch.zeros(2, 3), torch.zeros(2, 4, 3))

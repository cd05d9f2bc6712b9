"""The errors of the body fit."""

import numpy as np
import pytest
from fit import constant_and_scatter


def test_errors_constant_in_a_joints_own_axes_by_hand() -> None:
    """Errors are 20 mm along the joint's x, and 3 mm up or down; the second frame turns x to y."""
    turns = np.array([np.eye(3), [[0, -1, 0], [1, 0, 0], [0, 0, 1]]])[:, None]
    errors_m = np.array([[0.02, 0, 0.003], [0, 0.02, -0.003]])[:, None]
    assert constant_and_scatter(turns, errors_m) == pytest.approx({"constant_mm": 20, "scatter_mm": 3})

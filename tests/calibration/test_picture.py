import dataclasses

import numpy as np
import pytest
from matplotlib.figure import Figure

from hnerf.calibration.picture import _draw_scene
from tests.calibration.synthetic import STANDING_M, ring


def test_a_camera_in_the_origin_is_drawn_too() -> None:
    """Its frustum reaches 0.15 of the 4 m to the person along rays to corners 499.5 px off, at 1000 px focal length."""
    camera = dataclasses.replace(ring(1)[0], R=np.eye(3), t_m=np.zeros(3))
    axes = Figure().subplots()
    _draw_scene(axes, [camera], {"c0": "ok"}, np.full((1, *STANDING_M.shape), [0.0, 0, 4]), (0, 2))
    depths_m = [np.asarray(line.get_ydata()).max() for line in axes.lines[-4:]]
    assert depths_m == pytest.approx([0.6 / np.sqrt(1 + 2 * 0.4995**2)] * 4)

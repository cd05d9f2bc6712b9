"""The face network's outputs, and what it says of a picture without a face."""

import numpy as np
import pytest

from hnerf.detection import faces
from hnerf.detection.faces import POINTS, SIZE, FaceNetwork
from hnerf.models import FACE_LANDMARKS, has_model


def test_points_and_probability_are_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    """The network gives x, y and a depth for each point, in pixels of its crop; a logit of ln 3 is a probability of
    3/4. A white pixel is 1."""
    raw = np.zeros((1, 1, POINTS * 3))
    raw[..., 3:6] = 10, 20, 5
    monkeypatch.setattr(faces, "Network", lambda name: lambda crop: [raw, np.full((1, 1, 1), np.log(3) * crop.max())])
    points, probability = FaceNetwork()(np.full((SIZE, SIZE, 3), 255, np.uint8))
    assert points.shape == (POINTS, 2) and points[1].tolist() == [10, 20] and not points[0].any()
    assert probability == pytest.approx(0.75)


def test_a_grey_picture_holds_no_face() -> None:
    if not has_model(FACE_LANDMARKS):
        pytest.skip("the networks are not installed; run `hnerf models`")
    assert FaceNetwork()(np.full((SIZE, SIZE, 3), 127, np.uint8))[1] < 0.1

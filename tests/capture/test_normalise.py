"""Keypoints of distorted lenses, which lenses are accepted, and how captures are named."""

from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest

from hnerf.capture.lens import Lens, checked_lens
from hnerf.capture.manifest import CaptureManifest, capture_name
from hnerf.capture.normalise import Normaliser
from hnerf.errors import InputError


def test_keypoints_near_the_edge_are_undistorted_exactly() -> None:
    """Points of the linear camera, distorted by OpenCV, return to where they were."""
    K, distortion = np.array([[870.0, 0, 960], [0, 870, 540], [0, 0, 1]]), np.array([-0.25, 0.0, 0.0, 0.0])
    lens = Lens("a", K, distortion, np.eye(3), np.zeros(3), (1920, 1080))
    x, y = np.meshgrid(np.linspace(-0.85, 0.85, 5), np.linspace(-0.5, 0.5, 5))
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    distorted_px = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, distortion)[0][:, 0]
    recorded = np.concatenate([distorted_px, np.ones((25, 1))], -1)[None]
    expected_px = (rays @ K.T)[:, :2]
    found = Normaliser.create(lens, (1920, 1080), 1920).keypoints(recorded)
    np.testing.assert_allclose(found[0, :, :2], expected_px, atol=0.02)


@pytest.mark.parametrize(("skew", "k1", "refused"), [(12.0, -0.1, True), (1e-9, -0.1, False), (12.0, 0.0, False)])
def test_skew_is_accepted_only_without_distortion(skew: float, k1: float, refused: bool) -> None:
    K, distortion = np.array([[800.0, skew, 499.5], [0, 800, 499.5], [0, 0, 1]]), np.array([k1, 0, 0, 0])
    source = Path("intri.yml")
    with pytest.raises(InputError, match=r"intri\.yml: camera a: has both skew") if refused else nullcontext():
        checked_lens((source, source), "a", K, distortion, np.eye(3), np.zeros(3), None)


def test_a_decomposed_folder_name_is_composed() -> None:
    composed, decomposed = "J\u00fcrgen", "Ju\u0308rgen"
    assert capture_name(Path("/recordings") / decomposed, CaptureManifest()) == composed

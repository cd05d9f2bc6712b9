"""How much of an image a distortion leaves, which lenses are accepted, how captures are named, and full disks."""

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.capture import write_image
from hnerf.capture.lens import Lens, checked_lens
from hnerf.capture.manifest import CaptureManifest, capture_name
from hnerf.capture.normalise import kept_share, lost_share
from hnerf.errors import InputError
from tests.full_disk import files_up_to


def test_kept_share_by_hand() -> None:
    """A row of 32 px. The lens moves a point 16 u px from the middle outwards, by a factor of 1 + u^2: one at u = 0.682
    to 16 px, the recorded border. Of the row's height at u, 1 / (1 + u^2) is kept: in all, atan(0.682) = 0.599."""
    K = np.array([[16.0, 0, 15.5], [0, 16, 0], [0, 0, 1]])
    lens = Lens("a", K, np.array([1.0, 0, 0, 0]), np.eye(3), np.zeros(3), (32, 1))
    assert kept_share(lens, (32, 1)) == pytest.approx(0.599, abs=0.01)


def test_lost_share_by_hand() -> None:
    """A row of 32 px. The lens moves a point 16 u px from the middle inwards, by a factor of 1 - u^2 / 10: the border
    of the undistorted image, at u = 1, to 14.4 px. The recorded width of du is (1 - 0.3 u^2) du, and 1 - u^2 / 10 of
    its height is kept: in all, 1 - 0.4 / 3 + 0.03 / 5 = 0.873."""
    K = np.array([[16.0, 0, 15.5], [0, 16, 0], [0, 0, 1]])
    lens = Lens("a", K, np.array([-0.1, 0, 0, 0]), np.eye(3), np.zeros(3), (32, 1))
    assert lost_share(lens, (32, 1)) == pytest.approx(1 - 0.873, abs=0.01)


@pytest.mark.parametrize(
    ("skew", "k1", "fisheye", "refused"),
    [
        (12.0, -0.1, False, True),
        (1e-9, -0.1, False, False),
        (12.0, 0.0, False, False),
        (12.0, 0.0, True, True),
        (1e-9, 0.0, True, False),
    ],
)
def test_skew_is_accepted_only_without_distortion(skew: float, k1: float, fisheye: bool, refused: bool) -> None:
    K, distortion = np.array([[800.0, skew, 499.5], [0, 800, 499.5], [0, 0, 1]]), np.array([k1, 0, 0, 0])
    with pytest.raises(InputError, match=r"intri\.yml: camera a: has both skew") if refused else nullcontext():
        checked_lens(Path("intri.yml"), "a", K, distortion, np.eye(3), np.zeros(3), None, fisheye=fisheye)


@pytest.mark.parametrize("count", [3, 6, 7, 9])
def test_a_distortion_of_another_model_is_refused(count: int) -> None:
    for fisheye, right in ((False, "4 or 5 or 8"), (True, "4")):
        with pytest.raises(InputError, match=rf"camera a: distortion has {count} numbers, not {right}; calibrate"):
            checked_lens(Path("a.toml"), "a", np.eye(3), np.zeros(count), np.eye(3), np.zeros(3), None, fisheye=fisheye)


def test_a_decomposed_folder_name_is_composed() -> None:
    composed, decomposed = "J\u00fcrgen", "Ju\u0308rgen"
    assert capture_name(Path("/recordings") / decomposed, CaptureManifest()) == composed


@pytest.mark.parametrize("name", ["mask.png", "image.jpg"])
def test_an_image_on_a_full_disk_is_an_error(name: str, tmp_path: Path) -> None:
    with files_up_to(100), pytest.raises(OSError, match=rf"File too large: .*{name}"):
        write_image(tmp_path / name, np.zeros((60, 60), np.uint8))

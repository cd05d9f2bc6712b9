import dataclasses
from pathlib import Path

import numpy as np
import pytest

from hnerf.calibration.refine import _refine_for_size
from hnerf.calibration.sizes import SIZE_CHANGES, size_reasons, size_unexplained
from hnerf.capture.bars import Area
from hnerf.capture.capture import Capture
from tests.calibration.synthetic import detections, ring, write_capture


@pytest.fixture
def narrow(tmp_path: Path) -> Capture:
    """Return a capture whose camera c1 was calibrated at 1080 x 1000 and recorded at 1000 x 1000."""
    cameras = ring(4)
    capture = write_capture(tmp_path, cameras, detections(cameras, 1))
    return dataclasses.replace(capture, calibrated_sizes_px=capture.calibrated_sizes_px | {"c1": (1080, 1000)})


def with_bars(narrow: Capture) -> Capture:
    return dataclasses.replace(narrow, picture_areas_px={"c1": Area(0, 37.0, 1000, 926)})


def test_each_size_change_by_hand() -> None:
    # f = 1000, principal point 499.5; the image was 80 px wider when calibrated.
    camera = ring(1)[0]
    changed = {what: change(camera, (1080, 1000), (1000, 1000)).K for what, change in SIZE_CHANGES.items()}
    assert changed["cropped or padded symmetrically"][0].tolist() == [1000, 0, 459.5]
    assert changed["cropped or padded on the left or at the top"][0].tolist() == [1000, 0, 419.5]
    # Positions scale from the image's border, which is half a pixel outside the first pixel's centre: 499.5 is 500 from
    # it and goes to 500 * 1000 / 1080 = 462.963, that is 462.463.
    assert changed["stretched"][:2].round(3).tolist() == [[925.926, 0, 462.463], [0, 1000, 499.5]]
    assert changed["scaled and padded symmetrically"][:2].round(3).tolist() == [
        [925.926, 0, 462.463],
        [0, 925.926, 499.5],
    ]


def test_size_changes_do_not_depend_on_shrinking() -> None:
    """The image was calibrated and recorded at twice the size, and is read at half of that."""
    camera = ring(1)[0]
    for change in SIZE_CHANGES.values():
        shrunk, whole = (change(camera, (times * 1080, times * 1000), (times * 1000,) * 2) for times in (2, 1))
        np.testing.assert_allclose(shrunk.K, whole.K)


def test_black_bars_explain_a_change_of_size(narrow: Capture) -> None:
    assert [name for name in narrow.cameras if size_unexplained(narrow, name)] == ["c1"]
    assert size_reasons(narrow, "c0") == []
    assert size_reasons(narrow, "c1") == [
        "calibrated at 1080x1000, recorded at 1000x1000: no black bars prove what was done to the picture"
    ]
    assert not size_unexplained(with_bars(narrow), "c1")
    assert (
        "scaled by 0.9259 and put 0.0 px from the left and 37.0 px from the top"
        in size_reasons(with_bars(narrow), "c1")[0]
    )


def test_residuals_decide_on_a_size_change_only_without_bars_and_with_proof(narrow: Capture) -> None:
    cameras = ring(4)
    keypoints = detections(cameras, 1)
    # The image was stretched: for it, the intrinsics of the wider image are 1.08 times too long horizontally.
    K = np.array([[1.08, 0, 0.04], [0, 1, 0], [0, 0, 1]]) @ cameras[1].K
    as_calibrated = [dataclasses.replace(c, K=K) if c.name == "c1" else c for c in cameras]
    costs: dict[str, float] = {}
    matched, notes = _refine_for_size(narrow, as_calibrated, keypoints, ("c1",), 3.0, costs)
    np.testing.assert_allclose(matched[1].K, cameras[1].K)
    assert "were stretched" in notes[0] and len(costs) == len(SIZE_CHANGES)
    kept, notes = _refine_for_size(narrow, as_calibrated, keypoints, ("c1",), 0.1, {})
    assert kept is as_calibrated and "cannot be told" in notes[0]
    assert _refine_for_size(with_bars(narrow), as_calibrated, keypoints, ("c1",), 3.0, {}) == (as_calibrated, [])

from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks, encode
from hnerf.errors import NotApplicableError
from hnerf.study.degradations.catalogue import Degradation
from tests.study.recording import write_recording

WIDTH_PX, HEIGHT_PX = 100, 200
BOX = slice(20, 60), slice(30, 70)  # 40 x 40


def masks() -> Masks:
    """Return masks of one box in frames 2 and 4 of camera 01."""
    mask = np.zeros((HEIGHT_PX, WIDTH_PX), bool)
    mask[BOX] = True
    return Masks({("01", frame): encode(mask) for frame in (2, 4)}, {"cameras": {}})


def changed(tmp_path: Path, kind: str, strength: float) -> list[np.ndarray]:
    """Return the degraded masks."""
    capture = write_recording(tmp_path)
    bad = Degradation(kind=kind, strength=strength, seed=0).apply(masks(), capture)
    assert list(bad.encoded) == [("01", 2), ("01", 4)]
    return [bad.get("01", frame) for frame in (2, 4)]


def test_masks_are_eroded_or_dilated_by_three_per_cent_of_the_width(tmp_path: Path) -> None:
    eroded, _ = changed(tmp_path, "mask_eroded", 3)
    assert eroded.sum() == 34 * 34
    assert eroded[23:57, 33:67].all()
    dilated, _ = changed(tmp_path, "mask_dilated", 3)
    # Sides grow by 3; of each corner's 3 x 3 px, those at most 3 px away (1, 1 to 2, 2) are 4.
    assert dilated.sum() == 40 * 40 + 4 * 40 * 3 + 4 * 4


@pytest.mark.parametrize("kind", ["mask_eroded", "mask_dilated"])
def test_eroding_or_dilating_by_less_than_a_pixel_is_not_applicable(kind: str, tmp_path: Path) -> None:
    """The nearest pixels across an edge are 1 px apart, more than 0.9 % of 100 px. 1 % removes or adds one ring."""
    with pytest.raises(NotApplicableError, match="ada: no mask would differ"):
        changed(tmp_path, kind, 0.9)
    ringed, _ = changed(tmp_path, kind, 1)
    assert ringed.sum() == (38 * 38 if kind == "mask_eroded" else 40 * 40 + 4 * 40)


def test_holes_take_their_share_to_within_one_disc(tmp_path: Path) -> None:
    pierced = changed(tmp_path, "mask_holes", 25)
    disc = 60  # px, at most, for a radius of 0.1 x 40 = 4 px
    for mask in pierced:
        assert 1200 - disc < mask.sum() <= 1200
        assert not mask[~masks().get("01", 2)].any()
    assert not np.array_equal(pierced[0], pierced[1])


def test_a_limb_is_cut_off_around_its_bone(tmp_path: Path) -> None:
    """All limbs' keypoints are at the same two places. Expect a cut from (40, 40) through (50, 40) to (55, 40), 8 px
    thick."""
    capture = write_recording(tmp_path)
    people = np.zeros((5, 1, 25, 3))
    people[:, 0, [3, 6, 10, 13]] = 40, 40, 1
    people[:, 0, [4, 7, 11, 14]] = 50, 40, 1
    np.savez_compressed(tmp_path / "keypoints.npz", **dict.fromkeys(capture.cameras, people))  # type: ignore[arg-type]
    bad = Degradation(kind="mask_limb", strength=100, seed=0).apply(masks(), Capture.load(tmp_path))
    cut = masks().get("01", 2) & ~bad.get("01", 2)
    assert cut[40, 38:58].all()
    rows, columns = np.nonzero(cut)
    assert (rows.min(), rows.max()) == pytest.approx((36, 44), abs=1)
    assert (columns.min(), columns.max()) == pytest.approx((36, 59), abs=1)


def test_cutting_limbs_is_not_applicable_if_chance_spares_all_masks(tmp_path: Path) -> None:
    """Limbs are to be cut from 1 % of two masks, but seed 0 draws .64 and .04."""
    capture = write_recording(tmp_path)
    with pytest.raises(NotApplicableError, match="ada: no mask would differ"):
        Degradation(kind="mask_limb", strength=1, seed=0).apply(masks(), capture)

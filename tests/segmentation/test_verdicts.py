import numpy as np
import pytest

from hnerf.segmentation.prior import Prior
from hnerf.segmentation.verdicts import MaskVerdict, area_jumps, judge_mask

BODY = np.zeros((20, 20), bool)
BODY[4:16, 8:12] = True  # 48 px
PRIOR = Prior(BODY, BODY, BODY, BODY, 12.0)


def test_a_good_mask_has_no_fault() -> None:
    assert judge_mask(BODY, PRIOR) == MaskVerdict(None, None, 48)


def test_empty_inverted_and_misplaced_masks_are_faulty() -> None:
    speck = np.zeros_like(BODY)
    speck[8, 8:12] = True  # 4 px, less than a tenth of 48
    assert "no person" in str(judge_mask(speck, PRIOR).fault)
    assert "inverted" in str(judge_mask(~BODY, PRIOR).fault)
    assert "misses the person" in str(judge_mask(np.roll(BODY, 5, axis=1), PRIOR).fault)


def test_a_mask_of_mostly_something_else_is_faulty() -> None:
    """The person can be within 48 of 400 px. A mask of twice as many pixels is accepted: just half are within."""
    assert "mostly not the person" in str(judge_mask(np.ones_like(BODY), PRIOR).fault)
    wide = BODY.copy()
    wide[4:16, 12:16] = True
    assert judge_mask(wide, PRIOR).fault is None


def test_an_inverted_mask_is_found_without_a_prior() -> None:
    nothing = np.zeros_like(BODY)
    assert "inverted" in str(judge_mask(~BODY, Prior(nothing, nothing, nothing, nothing, 0.0)).fault)


def test_a_mask_cut_off_by_the_border_is_only_noted() -> None:
    mask = BODY.copy()
    mask[4:, 8:12] = True
    verdict = judge_mask(mask, PRIOR)
    assert verdict.fault is None
    assert verdict.note == "cut off by the image's border (bottom)"


@pytest.mark.parametrize("stride", [1, 3, 10])
def test_an_area_jump_must_contradict_both_neighbours_and_prior(stride: int) -> None:
    # The third frame leaks to twice its area; the seventh is twice as large because the person is; the last has no
    # neighbours.
    frames = tuple(stride * frame for frame in (0, 1, 2, 3, 4, 5, 6, 7, 8, 20))
    areas = [100, 100, 200, 100, 100, 100, 200, 100, 100, 300]
    expected = [50, 50, 50, 50, 50, 50, 100, 50, 50, 50]
    found = area_jumps(frames, [MaskVerdict(None, None, area) for area in areas], expected)
    assert found == {2 * stride: "area jumps from 100 to 200 px"}


def test_a_hole_is_a_jump_and_masks_with_a_fault_are_neither_judged_nor_neighbours() -> None:
    """The fifth mask has lost 70 px; all but the last of those after it have a fault, so the last has no neighbours."""
    areas = [100, 100, 100, 100, 30, 900, 900, 900, 900, 100]
    verdicts = [MaskVerdict("too large" if area == 900 else None, None, area) for area in areas]
    assert area_jumps(tuple(range(10)), verdicts, [50] * 10) == {4: "area jumps from 100 to 30 px"}


def test_a_mask_is_compared_with_near_frames_only() -> None:
    looked_at = list[object]()

    class Frames(tuple[int, ...]):
        def __getitem__(self, number: object) -> int:
            looked_at.append(number)
            return super().__getitem__(number)

    assert area_jumps(Frames(range(300)), [MaskVerdict(None, None, 1000)] * 300, [1000] * 300) == {}
    assert len(looked_at) < 20 * 300  # not 300 * 300


def test_a_mask_that_touches_all_sides_is_inverted_only_if_it_covers_most_of_the_image() -> None:
    """A person in close-up, whom no keypoint shows: a cross of 39 of 400 pixels."""
    cross, nothing = np.zeros((2, 20, 20), bool)
    cross[10], cross[:, 10] = True, True
    assert judge_mask(cross, Prior(nothing, nothing, nothing, nothing, 0.0)).fault is None

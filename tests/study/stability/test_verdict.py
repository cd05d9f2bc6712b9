import pytest

from hnerf.study.stability.verdict import RunVerdict, judge, near_border

GOOD = {"psnr": 30.0, "chamfer_mm": 6.0, "empty_psnr": 18.0}


@pytest.mark.parametrize(
    ("psnr", "chamfer_mm", "expected"),
    [
        (29.0, 7.5, "ok"),
        (31.0, 5.0, "ok"),
        (28.5, 7.5, "degraded: 1.5 dB of PSNR lost"),
        (29.0, 9.0, "degraded: Chamfer distance times 1.50"),
        (28.0, 12.0, "degraded: 2.0 dB of PSNR lost; Chamfer distance times 2.00"),
        (23.0, 12.0, "failed: 7.0 dB of PSNR lost"),
        (17.9, 6.0, "failed: pictures are no better than empty ones"),
        (28.0, 24.0, "failed: Chamfer distance times 4.00"),
        (float("nan"), 6.0, "failed: nan dB of PSNR lost"),
        (None, 6.0, "ok"),
        (None, None, "unscored: no image or surface is scored in both runs"),
    ],
)
def test_the_worse_of_psnr_and_chamfer_distance_counts(
    psnr: float | None, chamfer_mm: float | None, expected: str
) -> None:
    verdict = judge({"psnr": psnr, "chamfer_mm": chamfer_mm}, GOOD, [])
    assert ": ".join(filter(None, (verdict.verdict, verdict.reason))) == expected


def test_losing_half_of_the_lead_over_an_empty_image_is_failure() -> None:
    """The reference has 20 dB, an empty image 16."""
    poor = {"psnr": 20.0, "chamfer_mm": None, "empty_psnr": 16.0}
    assert judge(poor | {"psnr": 18.1}, poor, []).verdict == "degraded"
    assert judge(poor | {"psnr": 17.9}, poor, []).verdict == "failed"


def test_losing_most_of_a_small_lead_is_failure_even_below_a_decibel() -> None:
    """The reference has 17.5 dB, an empty image 16: a loss of 0.9 dB is more than half of the difference, one of 0.7 dB
    is not."""
    little = {"psnr": 17.5, "chamfer_mm": None, "empty_psnr": 16.0}
    assert judge(little | {"psnr": 16.6}, little, []) == RunVerdict("failed", "0.9 dB of PSNR lost")
    assert judge(little | {"psnr": 16.8}, little, []) == RunVerdict("ok")


def test_the_reference_run_is_judged_too() -> None:
    worthless = {"psnr": 15.0, "chamfer_mm": None, "empty_psnr": 16.0}
    assert judge(worthless, worthless, []).verdict == "failed"


def test_a_faulty_surface_is_failure_whatever_the_scores() -> None:
    assert judge(GOOD, GOOD, ["no surface", "a hole"]) == RunVerdict("failed", "no surface")
    unknown = {"psnr": None, "chamfer_mm": None}
    assert judge(unknown, unknown, ["no surface"]) == RunVerdict("failed", "no surface")


def test_only_surfaces_are_judged_if_there_are_no_scores() -> None:
    assert judge(None, {}, []) == RunVerdict("ok")
    assert judge(None, {}, ["no surface"]) == RunVerdict("failed", "no surface")


@pytest.mark.parametrize(
    ("psnr", "chamfer_mm", "near"),
    [
        (29.3, 7.0, False),  # 0.7 dB, times 1.17: a fifth less than 1 dB and 1.25 are 0.8 dB and 1.2
        (29.15, 6.0, True),
        (28.85, 6.0, True),
        (28.7, 6.0, False),  # 1.3 dB, over 1.2
        (30.0, 7.4, True),  # times 1.23
        (30.0, 7.9, False),  # times 1.32, over 1.3
        (28.7, 7.4, False),  # degraded in any case by its images
        (25.0, 6.0, True),  # 5 dB of 6, which is half of the 12 above an empty image
        (30.0, 15.7, True),  # times 2.62, of 2.6 to 3.4
        (30.0, 15.5, False),
    ],
)
def test_a_verdict_is_near_a_border_if_it_changes_with_limits_a_fifth_lower_or_higher(
    psnr: float, chamfer_mm: float, near: bool
) -> None:
    assert near_border({"psnr": psnr, "chamfer_mm": chamfer_mm}, GOOD, []) == near


def test_a_verdict_by_surfaces_alone_is_not_near_a_border() -> None:
    assert not near_border(None, {}, [])
    assert not near_border({"psnr": 29.0, "chamfer_mm": 6.0}, GOOD, ["no surface"])

"""Claims checked on a synthetic result: H-NeRF and one other method, from two and from four cameras."""

from typing import Any, get_args

import pytest

from hnerf.study.benchmark.claims import CHECKS, claim_lines
from hnerf.study.benchmark.plan import Claim
from tests.study.benchmark.test_results import scores


def of_method(psnr: float, chamfer: float, iou: float, cameras: int, slope: float) -> dict[str, Any]:
    """Return scores. slope: dB lost per degree of view angle and per degree of pose distance."""
    found = scores(psnr, 1.0, "") | {"trained_on": {"cameras": cameras, "frames": 1}}
    rows = [
        {"view_angle_deg": x, "pose_distance_deg": x, "psnr": psnr + offset - slope * x}
        for x, offset in ((0.0, 0.0), (30.0, 1.0), (60.0, -1.0), (90.0, 0.0))
    ]
    geometry = {"chamfer_l2_e3": chamfer, "iou": iou}
    found["novel_view"] = {"psnr": psnr, "per_image": rows, "geometry": geometry}
    found["novel_pose"] = {"psnr": psnr, "per_image": rows, "geometry": None}
    return found


def synthetic_result(check: str, **changes: Any) -> dict[str, Any]:
    """Return a result. PSNR and Chamfer of fast: 28 to 30 dB, 0.2 to 0.1; of nerf: 20 to 26 dB, 0.9 to 0.5."""
    fast = {2: (28.0, 0.2, 0.9), 4: (30.0, 0.1, 0.9)} | changes.get("fast", {})
    nerf = {2: (20.0, 0.9, 0.05), 4: (26.0, 0.5, 0.05)} | changes.get("nerf", {})
    slope = changes.get("slope", 0.1)
    variants = {
        f"{n} cameras": {"methods": {"fast": of_method(*fast[n], n, slope), "nerf": of_method(*nerf[n], n, slope)}}
        for n in (4, 2)
    }
    claims = [{"says": "It works.", "check": check}]
    return {"sweep": "cameras", "own": ["fast"], "claims": claims, "variants": variants}


def verdict(result: dict[str, Any]) -> str:
    (line,) = claim_lines(result)
    return line.removeprefix("- The paper: “It works.” Seen here: ")


def test_every_check_that_a_study_may_name_exists() -> None:
    assert set(CHECKS) == set(get_args(Claim.model_fields["check"].annotation))


def test_more_is_better() -> None:
    assert verdict(synthetic_result("more_is_better")) == (
        "yes: fast 28.0, 30.0 dB; nerf 20.0, 26.0 dB; fast Chamfer 0.200, 0.100; nerf Chamfer 0.900, 0.500."
    )
    assert verdict(synthetic_result("more_is_better", nerf={4: (26.0, 1.0, 0.05)})).startswith("no: ")


@pytest.mark.parametrize(
    ("psnr", "chamfer", "seen"),
    [
        ((28.0, 30.0, 29.7), (0.9, 0.5, 0.54), "yes: fast 28.0, 30.0, 29.7 dB; fast Chamfer 0.900, 0.500, 0.540."),
        ((28.0, 30.0, 29.5), (0.9, 0.5, 0.4), "no: fast 28.0, 30.0, 29.5 dB"),
        ((28.0, 29.0, 30.0), (0.9, 1.0, 0.4), "no: fast 28.0, 29.0, 30.0 dB; fast Chamfer 0.900, 1.000, 0.400."),
        ((28.0, 27.8, 28.0), (0.9, 0.5, 0.4), "no: "),
    ],
    ids=["falls as much as seeds vary", "falls in the end", "falls on the way", "ends where it began"],
)
def test_more_is_better_at_every_step(psnr: tuple[float, ...], chamfer: tuple[float, ...], seen: str) -> None:
    """Seeds alone move PSNR by 0.4 dB, and Chamfer by a tenth."""
    result = synthetic_result("more_is_better")
    figures = zip((2, 4, 8), psnr, chamfer, strict=True)
    result["variants"] = {f"{n} cameras": {"methods": {"fast": of_method(db, c, 0.9, n, 0.1)}} for n, db, c in figures}
    assert verdict(result).startswith(seen)


def test_more_is_not_better_for_a_method_that_fails_with_more() -> None:
    """fast fails with eight cameras, with all, and with the fewest alone, where more do help."""
    assert verdict(without_fast("more_is_better", 8)) == (
        "no: 8 cameras: fast no images; fast 28.0, 30.0 dB; nerf 20.0, 26.0, 26.2 dB; "
        "8 cameras: fast no surface; fast Chamfer 0.200, 0.100; nerf Chamfer 0.900, 0.500, 0.490."
    )
    nowhere = without_fast("more_is_better", 8)
    for variant in nowhere["variants"].values():
        variant["methods"]["fast"] = {"error": "no surface"}
    assert verdict(nowhere).startswith("no: 2 cameras: fast no images; 4 cameras: fast no images; 8 cameras: fast no")
    assert verdict(without_fast("more_is_better", 2)).startswith("yes: fast 30.0, 30.5 dB; nerf 20.0, 26.0, 26.2 dB")


@pytest.mark.parametrize("check", ["more_is_better", "loses_least"])
def test_variants_that_calibration_left_with_the_same_cameras_show_nothing(check: str) -> None:
    """Of four cameras, calibration leaves out two."""
    result = synthetic_result(check)
    for scores_of_four in result["variants"]["4 cameras"]["methods"].values():
        scores_of_four["trained_on"]["cameras"] = 2
    assert verdict(result) == "no figures."


def test_the_first_method_loses_least() -> None:
    assert verdict(synthetic_result("loses_least")) == (
        "yes: fast loses 2.0 dB, nerf 6.0 dB; fast loses Chamfer 0.100, nerf Chamfer 0.400."
    )
    assert verdict(synthetic_result("loses_least", fast={2: (23.0, 0.2, 0.9)})).startswith("no: fast loses 7.0 dB")


def test_the_first_method_is_ahead() -> None:
    assert verdict(synthetic_result("ahead")).startswith(
        "yes: 4 cameras: fast 30.0 dB, nerf 26.0 dB; 4 cameras: fast Chamfer"
    )
    assert verdict(synthetic_result("ahead", nerf={2: (20.0, 0.1, 0.0)})).startswith("no: ")


def test_the_first_method_must_be_ahead_of_the_best_other_method() -> None:
    result = synthetic_result("ahead")
    result["variants"]["4 cameras"]["methods"]["idr"] = of_method(31.0, 0.7, 0.05, 4, 0.1)
    assert verdict(result).startswith(
        "no: 4 cameras: fast 30.0 dB, idr 31.0 dB; 4 cameras: fast Chamfer 0.100, nerf Chamfer 0.500; "
    )


def without_fast(check: str, cameras: int) -> dict[str, Any]:
    """Return a result from two, four and eight cameras in which H-NeRF failed with `cameras` of them."""
    result = synthetic_result(check)
    eight = {"fast": of_method(30.5, 0.08, 0.9, 8, 0.1), "nerf": of_method(26.2, 0.49, 0.05, 8, 0.1)}
    result["variants"]["8 cameras"] = {"methods": eight}
    result["variants"][f"{cameras} cameras"]["methods"]["fast"] = {"error": "no surface"}
    return result


def test_a_failure_of_the_first_method_supports_no_claim() -> None:
    """Both have scores from eight and four cameras: they lose 0.5 and 0.2 dB, and Chamfer 0.02 and 0.01."""
    assert verdict(without_fast("ahead", 2)).startswith("no: 4 cameras: fast 30.0 dB, nerf 26.0 dB; ")
    assert "; 2 cameras: fast nothing, nerf 20.0 dB; " in verdict(without_fast("ahead", 2))
    assert verdict(without_fast("loses_least", 2)) == (
        "no: 2 cameras: fast nothing, nerf 20.0 dB; fast loses 0.5 dB, nerf 0.2 dB; "
        "2 cameras: fast nothing, nerf Chamfer 0.900; fast loses Chamfer 0.020, nerf Chamfer 0.010."
    )


def test_losses_are_compared_over_the_same_numbers_of_cameras() -> None:
    """`nerf` has no scores from two cameras, so `fast` loses 0.5 dB, from eight to four, not 2.5 dB, to two."""
    result = without_fast("loses_least", 4)
    methods = result["variants"]["2 cameras"]["methods"]
    result["variants"]["4 cameras"]["methods"]["fast"] = of_method(30.0, 0.1, 0.9, 4, 0.1)
    methods["nerf"] = {"error": "no surface"}
    assert verdict(result).startswith("no: fast loses 0.5 dB, nerf 0.2 dB; ")


def test_quality_by_view_angle_and_lead_at_every_angle() -> None:
    """Use six bins of 15 degrees, of which the first and the last hold one image each."""
    found = verdict(synthetic_result("falls_with_angle"))
    assert found.startswith(
        "yes: 4 cameras: fast 30.0 dB at 0°, 21.0 at 90°; 4 cameras: nerf 26.0 dB at 0°, 17.0 at 90°"
    )
    assert verdict(synthetic_result("falls_with_angle", slope=-0.1)).startswith("no: ")
    ahead = verdict(synthetic_result("ahead_at_every_angle"))
    assert ahead == "yes: 4 cameras: +4.0 to +4.0 dB to nerf; 2 cameras: +8.0 to +8.0 dB to nerf."
    assert verdict(synthetic_result("ahead_at_every_angle", nerf={4: (31.0, 0.5, 0.05)})).startswith("no: ")
    failed = verdict(without_fast("ahead_at_every_angle", 4))
    assert failed.startswith("no: 4 cameras: fast nothing, nerf has scores; 2 cameras: +8.0")


def test_a_lead_at_most_angles_is_not_one_at_every_angle() -> None:
    """At 30 degrees, `nerf` is 5 dB better than `fast`, which is ahead elsewhere."""
    result = synthetic_result("ahead_at_every_angle")
    result["variants"]["4 cameras"]["methods"]["nerf"]["novel_view"]["per_image"][1]["psnr"] += 9.0
    assert verdict(result).startswith("no: 4 cameras: -5.0 to +4.0 dB to nerf; ")


def test_only_bins_of_angles_that_both_methods_have_are_compared() -> None:
    """With bodies fitted under other settings, an image falls into the next bin, or is not there."""
    result = synthetic_result("ahead_at_every_angle")
    rows = result["variants"]["4 cameras"]["methods"]["nerf"]["novel_view"]["per_image"]
    rows[1] |= {"view_angle_deg": rows[1]["view_angle_deg"] + 15, "psnr": 99.0}
    del rows[2:-1]
    assert verdict(result).startswith("yes: 4 cameras: +4.0 to +4.0 dB to nerf; ")


@pytest.mark.parametrize(("slope", "seen"), [(0.0, "yes: 4 cameras: correlation -0.32 over 4 images"), (0.1, "no: ")])
def test_scores_of_new_poses_have_no_trend_with_pose_distance(slope: float, seen: str) -> None:
    """Without a slope, deviations of x are -45, -15, 15, 45 and of y 0, 1, -1, 0: -30 / sqrt(4500 x 2)."""
    assert verdict(synthetic_result("no_trend_with_pose", slope=slope)).startswith(seen)


@pytest.mark.parametrize(
    ("check", "images", "seen"),
    [
        ("falls_with_angle", 1, "no figures."),
        ("falls_with_angle", 2, "yes: 4 cameras: fast 30.0 dB at 0°, 28.0 at 30°; "),
        ("no_trend_with_pose", 2, "no figures."),
        ("no_trend_with_pose", 3, "no: 4 cameras: correlation -0.97 over 3 images; "),
    ],
)
def test_a_fall_takes_two_images_and_a_trend_three(check: str, images: int, seen: str) -> None:
    """Deviations of x are -30, 0, 30 and of y 3, 1, -4: -210 / sqrt(1800 x 26). Through two points, any line fits."""
    result = synthetic_result(check)
    for variant in result["variants"].values():
        for method in variant["methods"].values():
            del method["novel_view"]["per_image"][images:]  # which are also those of novel poses
    assert verdict(result).startswith(seen)


@pytest.mark.filterwarnings("error")
def test_equal_scores_have_no_trend() -> None:
    result = synthetic_result("no_trend_with_pose")
    for variant in result["variants"].values():
        for row in variant["methods"]["fast"]["novel_pose"]["per_image"]:
            row["psnr"] = 30.1
    assert verdict(result).startswith("yes: 4 cameras: correlation +0.00 over 4 images")


def test_whether_other_methods_have_no_surface() -> None:
    assert (
        verdict(synthetic_result("others_have_no_surface"))
        == "yes: 4 cameras: nerf IoU 0.05; 2 cameras: nerf IoU 0.05."
    )
    assert verdict(synthetic_result("others_have_no_surface", nerf={2: (20.0, 0.9, 0.3)})).startswith("no: ")


@pytest.mark.parametrize(
    ("reason", "seen"),
    [
        ("signed distance field: not finite; training diverged", "yes: 4 cameras: nerf no surface; "),
        ("the capture has no ground-truth surface in these frames", "yes: 2 cameras: nerf IoU 0.05."),
    ],
)
def test_a_surface_without_ground_truth_does_not_count(reason: str, seen: str) -> None:
    result = synthetic_result("others_have_no_surface")
    unknown = {"geometry": None, "geometry_reason": reason}
    result["variants"]["4 cameras"]["methods"]["nerf"]["novel_view"] |= unknown
    assert verdict(result).startswith(seen)


@pytest.mark.parametrize("check", ["loses_least", "ahead", "ahead_at_every_angle", "no_trend_with_pose"])
def test_no_claim_is_checked_if_no_preset_of_the_method_ran(check: str) -> None:
    assert verdict(synthetic_result(check) | {"own": []}) == "no figures."


@pytest.mark.parametrize("check", ["loses_least", "ahead", "ahead_at_every_angle", "others_have_no_surface"])
def test_further_presets_of_the_method_do_not_count_as_other_methods(check: str) -> None:
    assert verdict(synthetic_result(check) | {"own": ["fast", "nerf"]}) == "no figures."


def test_claims_are_about_the_first_preset_of_the_method() -> None:
    """A second one would be behind `idr`."""
    result = synthetic_result("ahead") | {"own": ["fast", "nerf"]}
    for n in (4, 2):
        result["variants"][f"{n} cameras"]["methods"]["idr"] = of_method(27.0, 0.3, 0.05, n, 0.1)
    assert verdict(result) == (
        "yes: 4 cameras: fast 30.0 dB, idr 27.0 dB; 4 cameras: fast Chamfer 0.100, idr Chamfer 0.300; "
        "2 cameras: fast 28.0 dB, idr 27.0 dB; 2 cameras: fast Chamfer 0.200, idr Chamfer 0.300."
    )


def test_all_other_methods_are_checked_if_the_method_failed() -> None:
    result = synthetic_result("others_have_no_surface", nerf={4: (26.0, 0.5, 0.3)})
    for variant in result["variants"].values():
        variant["methods"]["fast"] = {"error": "it came apart"}
    assert verdict(result) == "no: 4 cameras: nerf IoU 0.30; 2 cameras: nerf IoU 0.05."


def test_no_claim_is_checked_without_scores() -> None:
    assert verdict(synthetic_result("ahead") | {"variants": {"8 cameras": {"left_out": "too few"}}}) == "no figures."

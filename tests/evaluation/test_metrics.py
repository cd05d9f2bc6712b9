import numpy as np
import pytest

from hnerf.evaluation.metrics import mask_box, mask_iou, psnr, score_image, ssim, trivial_psnr


def test_psnr_of_a_constant_error() -> None:
    a = np.full((8, 8, 3), 0.5)
    assert psnr(a, a + 0.1) == pytest.approx(20.0)  # -10 log10(0.1^2)
    assert psnr(a, a) == pytest.approx(100.0)


def test_ssim_of_flat_images_is_its_luminance_term() -> None:
    a, b = np.full((16, 16, 3), 0.5), np.full((16, 16, 3), 0.6)
    # (2 a b + C1) / (a^2 + b^2 + C1) with C1 = 0.01^2; the contrast term of flat images is 1
    assert ssim(a, b) == pytest.approx((2 * 0.5 * 0.6 + 1e-4) / (0.5**2 + 0.6**2 + 1e-4), abs=1e-6)
    assert ssim(a, a) == pytest.approx(1.0)


def test_ssim_of_one_window_by_hand() -> None:
    """The images are as large as the window, 11 px, so each channel gives one number, from means, variances and the
    covariance under a Gaussian of 1.5 px that sums to 1, with C1 = 0.01^2 and C2 = 0.03^2."""
    a, b = np.random.default_rng(0).uniform(size=(2, 11, 11, 3))
    b = (a + b) / 2
    along = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(along, along)[..., None] / along.sum() ** 2
    mean_a, mean_b = ((window * image).sum((0, 1)) for image in (a, b))
    var_a, var_b = (window * (a - mean_a) ** 2).sum((0, 1)), (window * (b - mean_b) ** 2).sum((0, 1))
    cov = (window * (a - mean_a) * (b - mean_b)).sum((0, 1))
    luminance = (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
    assert ssim(a, b) == pytest.approx((luminance * (2 * cov + 9e-4) / (var_a + var_b + 9e-4)).mean(), abs=1e-9)


def test_ssim_of_images_smaller_than_its_window() -> None:
    """With black below them, 9 rows have as many as the window."""
    a, b = np.random.default_rng(0).random((2, 11, 16, 3))
    a[9:] = b[9:] = 0
    assert ssim(a[:9], b[:9]) == ssim(a, b) < 0.5
    assert ssim(a[:9, :5], a[:9, :5]) == pytest.approx(1.0)


def test_mask_box_is_padded_and_clipped_to_the_image() -> None:
    mask = np.zeros((100, 80), bool)
    mask[30:41, 5:9] = True
    rows, columns = mask_box(mask)
    assert range(100)[rows] == range(10, 61)  # 30 - 20 to 40 + 20
    assert range(80)[columns] == range(0, 29)  # 5 - 20 is outside; 8 + 20


def test_mask_iou_counts_pixels_with_more_than_half_coverage() -> None:
    coverage = np.zeros((2, 4), np.uint8)
    coverage[0, :3] = 128
    coverage[1, :] = 127  # just below one half
    mask = np.zeros((2, 4), bool)
    mask[0, 1:] = True
    assert mask_iou(coverage, mask) == pytest.approx(2 / 4)


def test_the_mask_iou_of_nobody_and_nothing_is_one() -> None:
    """Results may not hold NaN."""
    nobody = np.zeros((2, 4), bool)
    assert mask_iou(np.zeros((2, 4), np.uint8), nobody) == 1.0 and mask_iou(np.full((2, 4), 255), nobody) == 0.0


def test_mask_iou_uses_coverage_not_brightness() -> None:
    """A head has 4 pixels, of which the upper two are black hair in image and rendering. By brightness, they would be
    missed."""
    mask = np.zeros((16, 16), bool)
    mask[2:4, 2:4] = True
    reference = np.zeros((16, 16, 3), np.uint8)
    reference[3, 2:4] = 200
    rendered = np.dstack([reference, 255 * mask.astype(np.uint8)])
    assert score_image(rendered, reference, mask)["mask_iou"] == 1.0
    rendered[2, 2:4, 3] = 0  # the rendering lacks the hair
    assert score_image(rendered, reference, mask)["mask_iou"] == pytest.approx(2 / 4)


def test_trivial_psnr_of_a_person_with_two_grey_levels() -> None:
    """The mask has 4 pixels in a box of 42 x 42: two of 0.2 and two of 0.4. Their mean 0.3 is 0.1 off everywhere in the
    mask."""
    reference = np.zeros((100, 100, 3), np.uint8)
    mask = np.zeros((100, 100), bool)
    mask[50:52, 50:52] = True
    reference[50, 50:52], reference[51, 50:52] = 51, 102
    found = trivial_psnr(reference, mask)
    assert found["empty_psnr"] == pytest.approx(-10 * np.log10((2 * 0.2**2 + 2 * 0.4**2) / 42**2), abs=1e-4)
    assert found["one_colour_psnr"] == pytest.approx(-10 * np.log10(4 * 0.1**2 / 42**2), abs=1e-4)


def test_score_image_uses_only_pixels_inside_the_box() -> None:
    reference = np.zeros((100, 100, 3), np.uint8)
    mask = np.zeros((100, 100), bool)
    mask[50, 50] = True
    rendered = np.zeros((100, 100, 4), np.uint8)
    rendered[0, 0] = 255  # outside the box of 41 x 41 px
    rendered[50, 50] = 51  # 0.2
    assert score_image(rendered, reference, mask)["psnr"] == pytest.approx(-10 * np.log10(0.2**2 / 41**2), abs=1e-4)

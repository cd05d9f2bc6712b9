import numpy as np
import pytest

from hnerf.asset import splat_rendering
from hnerf.asset.splat_rendering import covariances, projected, render_splats
from hnerf.geometry.camera import Camera

STRAIGHT = np.array([[1.0, 0, 0, 0]])  # no rotation
QUARTER = np.array([[0.5**0.5, 0, 0, 0.5**0.5]])  # rotates by 90 degrees about z: x to y
RED, GREEN = [1.0, 0, 0], [0, 1.0, 0]


def camera() -> Camera:
    """Return a camera at the origin that looks along z. At 2 m, 1 cm is 1 px wide and 2 px high."""
    return Camera("c", np.array([[200.0, 0, 40], [0, 400, 30], [0, 0, 1]]), np.eye(3), np.zeros(3), 81, 61)


def ball(sigma_m: float) -> np.ndarray:
    return np.full(3, sigma_m)


def test_a_splat_is_a_gaussian_around_its_projected_centre() -> None:
    """A splat of 5 cm at 2 m and 10 cm to the right is 5 px by 10 px at column 50."""
    found = render_splats(np.array([[0.1, 0, 2.0]]), STRAIGHT, ball(0.05), 0.8, np.array([[1.0, 0.5, 0]]), camera())
    assert np.unravel_index(found[..., 3].argmax(), (61, 81)) == (30, 50)
    np.testing.assert_allclose(found[30, 50], [0.8, 0.4, 0, 0.8], rtol=1e-9)
    # Off the optical axis, the extent in depth projects too: its slope is 10 px in 2 m, or 5 px per metre.
    across_px2 = 5**2 + (5 * 0.05) ** 2
    assert found[30, 57, 3] == pytest.approx(0.8 * np.exp(-(7**2) / 2 / across_px2))
    assert found[38, 50, 3] == pytest.approx(0.8 * np.exp(-(8**2) / 2 / 10**2))
    assert found[30, 70, 3] == 0  # exp(-400 / 50) is less than one 8-bit level


def test_splats_are_composited_by_depth_whatever_their_order() -> None:
    middles_m, colours = np.array([[0, 0, 3.0], [0, 0, 2.0]]), np.array([RED, GREEN])
    for order in ([0, 1], [1, 0]):
        turned = np.repeat(STRAIGHT, 2, 0)
        found = render_splats(middles_m[order], turned, ball(0.05), 0.6, colours[order], camera())
        np.testing.assert_allclose(found[30, 40], [0.4 * 0.6, 0.6, 0, 0.6 + 0.4 * 0.6], rtol=1e-9)


def test_rendering_in_blocks_matches_rendering_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    middles_m, colours = rng.uniform([-0.5, -0.2, 1.5], [0.5, 0.2, 3], (200, 3)), rng.uniform(size=(200, 3))
    turned = rng.normal(size=(200, 4))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    whole = render_splats(middles_m, turned, np.array([0.03, 0.03, 0.003]), 0.9, colours, camera())
    monkeypatch.setattr(splat_rendering, "MOST_AT_ONCE", 50)
    np.testing.assert_allclose(
        render_splats(middles_m, turned, np.array([0.03, 0.03, 0.003]), 0.9, colours, camera()), whole, atol=1e-12
    )
    one_by_one = np.ones((61, 81))
    for k in range(200):
        one = render_splats(
            middles_m[k : k + 1], turned[k : k + 1], np.array([0.03, 0.03, 0.003]), 0.9, colours[:1], camera()
        )
        one_by_one *= 1 - one[..., 3]
    np.testing.assert_allclose(whole[..., 3], 1 - one_by_one, atol=1e-12)


def test_splats_behind_the_camera_or_outside_the_image_are_not_drawn() -> None:
    middles_m = np.array([[0, 0, -2.0], [0, 0, 0.01], [50, 0, 2.0]])
    found = render_splats(middles_m, np.repeat(STRAIGHT, 3, 0), ball(0.05), 0.9, np.ones((3, 3)), camera())
    assert not found.any()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_covariance_of_a_splat_rotated_about_each_axis(axis: int) -> None:
    """Turning by 30 degrees about x takes y towards z, about y takes z towards x, and about z takes x towards y."""
    variances, (first, second) = np.array([9.0, 4.0, 1.0]), ((axis + 1) % 3, (axis + 2) % 3)
    quaternion = np.array([[np.cos(np.pi / 12), 0, 0, 0]])
    quaternion[0, 1 + axis] = np.sin(np.pi / 12)
    found = covariances(quaternion, np.sqrt(variances))[0]
    assert found[axis, axis] == pytest.approx(variances[axis])
    assert found[first, first] == pytest.approx(0.75 * variances[first] + 0.25 * variances[second])
    assert found[first, second] == pytest.approx(0.75**0.5 / 2 * (variances[first] - variances[second]))


def test_a_rotated_disc_projects_edge_on_from_the_side() -> None:
    """The disc of 2 cm by 4 cm by 1 mm is turned by 90 degrees about z. It is seen along z and by a camera that looks
    along -x."""
    scales_m = np.array([0.02, 0.04, 0.001])
    np.testing.assert_allclose(covariances(QUARTER, scales_m)[0], np.diag([0.04, 0.02, 0.001]) ** 2, atol=1e-12)
    middle_m = np.array([[0, 0, 2.0]])
    seen_px2 = projected(middle_m, covariances(QUARTER, scales_m), camera())[0]
    np.testing.assert_allclose(seen_px2, np.diag([4**2, 4**2]), atol=1e-9)
    aside = Camera("c", camera().K, np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.array([-2.0, 0, 2.0]), 81, 61)
    seen_px2 = projected(middle_m, covariances(QUARTER, scales_m), aside)[0]
    np.testing.assert_allclose(seen_px2, np.diag([0.1**2, 4**2]), atol=1e-9)

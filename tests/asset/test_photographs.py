"""Textures from photographs: squares in front of a camera, worked out by hand."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hnerf.asset import photographs
from hnerf.asset.photographs import (
    FIELD_WEIGHT,
    OUTLIER,
    BackProjection,
    CapturedBlend,
    SeenSurface,
    SeenTexels,
    TexelPixels,
    photographed_texels,
    sampled,
    visible_texels,
)
from hnerf.asset.texture import Texels
from hnerf.avatar.avatar import Gains
from hnerf.geometry.camera import Camera

SIZE_PX = 101
FACES = np.array([[0, 2, 1], [0, 3, 2]])  # seen from the front, towards -z


def camera(name: str = "front", angle: float = 0.0) -> Camera:
    """Return a camera 2 m from the origin, turned about the vertical. At the origin, 1 m spans 50 px."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    return Camera(name, K, R, np.array([0, 0, 2.0]), SIZE_PX, SIZE_PX)


def square(half_m: float, z_m: float) -> np.ndarray:
    """Return the corners of an upright square."""
    return np.array([[-half_m, -half_m, z_m], [half_m, -half_m, z_m], [half_m, half_m, z_m], [-half_m, half_m, z_m]])


def texels_at(face: list[int], barycentric: list[list[float]]) -> Texels:
    """Return texels at given faces and barycentric coordinates."""
    place = np.zeros(len(face), int)
    return Texels(place, place, np.array(face), np.array(barycentric, np.float32))


MIDDLE = [0.5, 0.5, 0.0]  # half-way between corners 0 and 2: the square's centre


def capture(photographs: dict[str, int], cameras: list[Camera]) -> Any:
    """Return a capture whose photographs are each a uniform grey level from 0 to 255."""
    image = {name: np.full((SIZE_PX, SIZE_PX, 3), level, np.uint8) for name, level in photographs.items()}
    return SimpleNamespace(
        cameras={c.name: c for c in cameras},
        train_cameras=tuple(c.name for c in cameras),
        image=lambda name, frame: image[name],
    )


def colours_from_photographs(
    capture: Any, gains: Gains, surfaces_m: dict[int, np.ndarray], faces: np.ndarray, texels: Texels, field: np.ndarray
) -> np.ndarray:
    """Return the blended colours of texels from all photographs."""
    surfaces = {frame: SeenSurface.of(vertices_m, faces) for frame, vertices_m in surfaces_m.items()}
    blend = CapturedBlend(field)
    for seen in photographed_texels(capture, gains, surfaces, texels):
        blend.add(seen)
    return blend.colours()


def test_a_texel_is_seen_where_it_projects() -> None:
    index, cosine, _, normals, pixels_px = visible_texels(
        camera(), SeenSurface.of(square(0.4, 0.0), FACES), texels_at([0], [[0.5, 0.25, 0.25]])
    )
    assert index.tolist() == [0]
    np.testing.assert_allclose(pixels_px, [[50, 40]], atol=1e-4)  # (0, -0.2) m, 50 px a metre
    np.testing.assert_allclose(cosine, [2 / np.sqrt(4.04)], atol=1e-6)
    np.testing.assert_allclose(normals, [[0, 0, -1]], atol=1e-6)


def test_normals_between_corners_are_normalised() -> None:
    """The normal on the edge of a fold is turned by 22.5 degrees towards +X; that of the corner left of it faces the
    camera. Half-way, at (-0.1, 0, 0), the normal is turned by 11.25 degrees."""
    bend = np.pi / 4
    folded_m = np.array([[-0.2, 0, 0], [0, -0.2, 0], [0, 0.2, 0], [0.2 * np.cos(bend), 0, 0.2 * np.sin(bend)]])
    fold = SeenSurface.of(folded_m, np.array([[0, 2, 1], [1, 2, 3]]))
    _, cosine, _, normals, _ = visible_texels(camera(), fold, texels_at([0], [[0.5, 0.25, 0.25]]))
    np.testing.assert_allclose(normals, [[np.sin(bend / 4), 0, -np.cos(bend / 4)]], atol=1e-6)
    np.testing.assert_allclose(cosine, np.cos(bend / 4 - np.arctan(0.1 / 2)), atol=1e-6)


def test_occluded_and_back_facing_squares_are_hidden() -> None:
    vertices_m = np.concatenate([square(0.4, 0.0), square(0.4, -0.3)])
    both = np.concatenate([FACES, FACES + 4])
    index, *_ = visible_texels(camera(), SeenSurface.of(vertices_m, both), texels_at([0, 2], [MIDDLE, MIDDLE]))
    assert index.tolist() == [1]
    averted = SeenSurface.of(square(0.4, 0.0), FACES[:, ::-1].copy())
    index, *_ = visible_texels(camera(), averted, texels_at([0], [MIDDLE]))
    assert len(index) == 0


def test_a_surface_that_reaches_past_the_camera_still_hides_what_is_behind_it() -> None:
    """One corner of a third triangle lies beside the camera at depth 0, on the image's vertical axis: it has no
    pixel."""
    beside_m = np.array([[0, 5, -2], [0.1, 5, -1.9], [0, 5, -1.9]])
    vertices_m = np.concatenate([square(0.4, 0.0), square(0.4, -0.3), beside_m])
    faces = np.concatenate([FACES, FACES + 4, [[8, 9, 10]]])
    index, *_ = visible_texels(camera(), SeenSurface.of(vertices_m, faces), texels_at([0, 2], [MIDDLE, MIDDLE]))
    assert index.tolist() == [1]


def test_a_square_behind_the_camera_is_not_seen() -> None:
    """The square is 2 m behind the camera and faces it; it projects, mirrored, to the middle of the image."""
    behind = SeenSurface.of(square(0.4, -4.0), FACES[:, ::-1].copy())
    index, *_ = visible_texels(camera(), behind, texels_at([0], [MIDDLE]))
    assert len(index) == 0


def test_a_slanted_surface_does_not_occlude_itself() -> None:
    """The surface is seen at 60 degrees from 2 m away. A texel that is half a pixel, 1 cm, off its pixel's ray is up to
    1.7 cm farther away than the point that the ray hits, which is less than 1 cm / cos 60."""
    share = np.linspace(0.38, 0.5, 50)  # weight of corner 0, for x from 0.1 m to 0
    texels = texels_at([0] * 50, [[s, 0.5, 0.5 - s] for s in share.tolist()])
    index, cosine, *_ = visible_texels(camera("side", np.pi / 3), SeenSurface.of(square(0.4, 0.0), FACES), texels)
    assert index.tolist() == list(range(50))
    assert cosine[-1] == pytest.approx(0.5)


def test_texels_near_an_outline_are_left_out() -> None:
    """The square ends at 30 and at 70 px. The third pixel inwards is the first whose neighbourhood has no depth
    jump."""
    at_px = np.array([31.0, 34.0, 66.0, 69.0])
    share = (at_px - 30) / 40  # along the diagonal from corner 0 to corner 2
    texels = texels_at([0] * 4, [[1 - s, s, 0] for s in share.tolist()])
    index, *_, pixels_px = visible_texels(camera(), SeenSurface.of(square(0.4, 0.0), FACES), texels)
    assert index.tolist() == [1, 2]
    np.testing.assert_allclose(pixels_px, [[34, 34], [66, 66]], atol=1e-4)


def test_weights_rise_over_eight_pixels_from_an_outline() -> None:
    """The square ends at 30 and at 70 px; the last pixels next to a jump in depth are 31 and 69."""
    at_px = np.array([34.0, 36.0, 45.0, 67.0])
    share = (at_px - 30) / 40
    texels = texels_at([0] * 4, [[1 - s, s, 0] for s in share.tolist()])
    _, _, feather, normals, _ = visible_texels(camera(), SeenSurface.of(square(0.4, 0.0), FACES), texels)
    np.testing.assert_allclose(feather, [3 / 8, 5 / 8, 1, 2 / 8])
    pixels = TexelPixels(np.arange(4), np.arange(4), np.full((4, 3), 0.5))
    weights = SeenTexels(pixels, np.ones(4), feather, normals, pixels.colours).weights(pixels.colours)
    np.testing.assert_allclose(weights[:, 0], feather)


def test_colours_are_weighted_by_the_fourth_power_of_the_cosine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before sharpening, views at 0 and 60 degrees have weights 1 and 1/16, times their agreement with the field's
    0.5."""
    monkeypatch.setattr(photographs, "BACK_PROJECTIONS", 0)
    cameras = [camera(), camera("side", np.pi / 3)]
    found = colours_from_photographs(
        capture({"front": 130, "side": 125}, cameras),
        {},
        {0: square(0.8, 0.0)},
        FACES,
        texels_at([0], [MIDDLE]),
        np.full((1, 3), 0.5),
    )
    colours = np.array([0.5, 130 / 255, 125 / 255])
    agreement = 1 / (1 + 3 * ((colours - 0.5) / OUTLIER) ** 2) ** 2
    weights = agreement * [FIELD_WEIGHT, 1, 1 / 16]
    np.testing.assert_allclose(found, (weights @ colours) / weights.sum(), atol=1e-5)


def test_gains_are_divided_out_and_unseen_texels_keep_the_fields_colour() -> None:
    found = colours_from_photographs(
        capture({"front": 204}, [camera()]),
        {"front": (2.0, 2.0, 2.0)},
        {0: np.concatenate([square(0.4, 0.0), square(0.2, 0.5)])},
        np.concatenate([FACES, FACES + 4]),
        texels_at([0, 2], [MIDDLE, MIDDLE]),
        np.array([[0.4, 0.4, 0.4], [0.1, 0.2, 0.3]]),
    )
    np.testing.assert_allclose(found, [[0.4, 0.4, 0.4], [0.1, 0.2, 0.3]], atol=1e-6)


def test_a_photograph_that_contradicts_the_field_has_little_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    """White differs from the field's black by sqrt(3) / OUTLIER outlier scales."""
    monkeypatch.setattr(photographs, "BACK_PROJECTIONS", 0)
    white, texels = capture({"front": 255}, [camera()]), texels_at([0], [MIDDLE])
    found = colours_from_photographs(white, {}, {0: square(0.4, 0.0)}, FACES, texels, np.zeros((1, 3)))
    vote = 1 / (1 + 3 / OUTLIER**2) ** 2
    assert found[0, 0] == pytest.approx(vote / (vote + FIELD_WEIGHT), abs=1e-6)


def test_unexplained_colour_is_pixel_minus_mean_of_its_texels() -> None:
    """Three texels lie in a pixel of 0.5 and have a mean of 0.4; a fourth, of 0.3, lies in a pixel of 0.2. With weights
    of 1, 3 and 4, the three have a mean of (0.2 + 3 x 0.6 + 4 x 0.4) / 8 = 0.45."""
    levels = np.array([[0.2], [0.3], [0.6], [0.4]]) * [1, 1, 1]
    pixel, photograph = np.array([0, 1, 0, 0]), np.array([[0.5] * 3, [0.2] * 3])
    pixels = TexelPixels(np.array([1, 2, 3, 4]), pixel, photograph)
    np.testing.assert_allclose(pixels.unexplained(levels, np.ones((4, 1)))[:, 0], [0.1, -0.1, 0.1, 0.1])
    weights = np.array([[1.0], [2], [3], [4]])
    np.testing.assert_allclose(pixels.unexplained(levels, weights)[:, 0], [0.05, -0.1, 0.05, 0.05])


def test_sharpening_leaves_a_texel_alone_if_others_in_its_pixels_hardly_count() -> None:
    """One texel is as the photograph shows it, 0.6; two black ones in the same pixel have a thousandth of its
    weight."""
    projection = BackProjection()
    counts = np.array([[1.0], [1e-3], [1e-3]])
    projection.add(TexelPixels(np.arange(3), np.zeros(3, int), np.full((1, 3), 0.6)), counts)
    sharpened = projection.sharpened(np.array([[0.6], [0], [0]]) * [1, 1, 1], np.array([[1.0], [1], [1]]))
    np.testing.assert_allclose(sharpened[0], 0.6, atol=0.005)


def test_sharpening_recovers_stripes_averaged_by_pixels() -> None:
    """The stripes are one texel wide, 0.3 and 0.5. Three photographs have pixels of three texels, each starting at
    another texel, so their pixels see 0.367 or 0.433. The mean of the pixels around a texel has a sixth of the contrast
    or less."""
    stripes = np.where(np.arange(60) % 2 == 0, 0.3, 0.5)[:, None] * [1, 1, 1]
    projection, mean = BackProjection(), np.zeros((60, 3))
    for start in range(3):
        pixel = (np.arange(60) + start) // 3
        photograph = np.stack([np.bincount(pixel, stripes[:, 0]) / np.bincount(pixel)] * 3, 1)
        projection.add(TexelPixels(np.arange(60), pixel, photograph), np.ones((60, 1)))
        mean += photograph[pixel] / 3
    inside = slice(6, -6)
    sharpened = projection.sharpened(mean, np.full((60, 1), 3.0))
    before, after = (np.abs(found - stripes)[inside].mean() for found in (mean, sharpened))
    assert after < 0.85 * before


def test_sharpening_divides_residuals_by_the_irradiance() -> None:
    """A texel of albedo 0.5 at irradiance 0.5 should show 0.35. It shows 0.1 too little, at a weight of 1 of 0.5 in
    all. It becomes 0.7, and stays there."""
    projection = BackProjection()
    pixels = TexelPixels(np.array([0]), np.array([0]), np.full((1, 3), 0.35))
    projection.add(pixels, np.ones((1, 1)), np.full((1, 1), 0.5))
    np.testing.assert_allclose(projection.sharpened(np.full((1, 3), 0.5), np.full((1, 1), 0.5)), 0.7)


def test_a_texel_lies_in_the_pixel_that_it_projects_to() -> None:
    """The texels project to (50, 40) and (50.2, 40)."""
    shaded: Any = capture({"front": 0}, [camera()])
    shaded.image("front", 0)[40, 50] = 200
    texels = texels_at([0, 0], [[0.5, 0.25, 0.25], [0.495, 0.255, 0.25]])
    surfaces = {0: SeenSurface.of(square(0.4, 0.0), FACES)}
    (seen,) = photographed_texels(shaded, {"front": (0.8, 0.8, 0.8)}, surfaces, texels)
    assert seen.pixels.index.tolist() == [0, 1] and seen.pixels.pixel.tolist() == [0, 0]
    np.testing.assert_allclose(seen.pixels.colours, [[200 / 255 / 0.8] * 3], rtol=1e-6)


def test_sampling_is_bilinear_and_clamped_to_the_border() -> None:
    """The image has rows 0, 100 and 50, 250. A quarter to the right and half-way down is (25 + 100) / 2."""
    image = np.repeat(np.array([[0, 100], [50, 250]], np.uint8)[..., None], 3, 2)
    found = 255 * sampled(image, np.array([[0.25, 0.5], [-3.0, 0.5], [7.0, 9.0]]))
    np.testing.assert_allclose(found, np.repeat([[62.5], [25], [250]], 3, 1), rtol=1e-6)

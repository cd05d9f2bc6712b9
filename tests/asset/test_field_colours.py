import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from hnerf.asset.field_colours import field_colours, filled, median_of_seen
from hnerf.asset.rig_transfer import clothed_rig
from hnerf.asset.texture import Texels, rasterise, texture_image, unwrap
from hnerf.body.fit_result import BodyFit
from tests.asset.figure import bending_body, column_rig, dressed, no_cavities, twice, upright_column
from tests.asset.stand_in import StandInAvatar, rest_colour

UPRIGHT = BodyFit(column_rig(), (0,), torch.zeros(1, 2, 3), torch.eye(4)[None])


def texels_of(clothes: trimesh.Trimesh) -> Texels:
    """Return the texels of a texture of 64 px."""
    return rasterise(unwrap(clothes.vertices, clothes.faces, 64), 64)


def middles_of(count: int) -> Texels:
    """Return a texel in the middle of each of the first faces."""
    return Texels(*np.zeros((2, count), int), np.arange(count), np.full((count, 3), 1 / 3, np.float32))


def test_colours_are_read_on_the_fields_own_surface() -> None:
    read_m = []

    class Recording(StandInAvatar):
        def colour(self, points_m: Tensor, directions: Tensor, theta: Tensor, root: Tensor) -> Tensor:
            read_m.append(self.signed_distance(points_m, theta, root))
            return super().colour(points_m, directions, theta, root)

    body = bending_body()
    clothes = upright_column(0.175, 0.2, 1.4)  # its sides are 1.5 cm outside the field's surface, its caps far inside
    posed = dressed(body, clothes)
    field_colours(Recording(body), posed, texels_of(clothes), no_cavities(posed))
    assert len(read_m) == len(body.frames)
    for distance_m in read_m:
        assert distance_m.abs().median() < 0.002


def test_baked_colours_match_the_point_on_the_rest_body() -> None:
    body = bending_body()
    clothes = upright_column(0.16, 0.0, 1.6)
    layout = unwrap(clothes.vertices, clothes.faces, 256)
    texels, posed = rasterise(layout, 256), dressed(body, clothes)
    colours = field_colours(StandInAvatar(body), posed, texels, no_cavities(posed))
    image = texture_image(texels, colours, 256)
    middle_uv = layout.uvs[layout.face_uvs].mean(1)
    pixel = image[((1 - middle_uv[:, 1]) * 256).astype(int), (middle_uv[:, 0] * 256).astype(int)]
    middle_m = torch.tensor(clothes.triangles_center).float()
    # Only between the caps, away from the joint (bending shears) and from borders of stripes. The body is 1 cm inside.
    z_m = middle_m[:, 2]
    sides = (z_m > 0.1) & (z_m < 1.5) & ((z_m - 0.8).abs() > 0.2) & ((z_m % 0.2 - 0.1).abs() < 0.09)
    inward = middle_m[:, :2] * (0.15 / middle_m[:, :2].norm(dim=1, keepdim=True))
    expected = rest_colour(torch.cat([inward, middle_m[:, 2:]], 1)).numpy()[sides.numpy()]
    assert sides.sum() > 100
    assert np.abs(pixel[sides.numpy()] / 255 - expected).max() < 0.03


def test_texels_off_the_fields_surface_take_the_surrounding_colour() -> None:
    """The clothes are 25 cm taller than the body. Above the body's top, the field's colour would be lighter than
    anywhere below."""

    class Height(StandInAvatar):
        def colour(self, points_m: Tensor, directions: Tensor, theta: Tensor, root: Tensor) -> Tensor:
            return points_m[:, 2:].expand(-1, 3) / 2

    clothes = upright_column(0.16, 0.0, 1.85)
    texels, posed = texels_of(clothes), dressed(UPRIGHT, clothes)
    colours = field_colours(Height(UPRIGHT), posed, texels, no_cavities(posed))
    z_m = clothes.triangles_center[texels.face, 2]
    assert colours[z_m > 1.7].max() < 0.83
    assert colours[z_m > 1.7].min() > 0.7


def test_cavities_take_the_surrounding_colour() -> None:
    """The upper half of a column is marked as a cavity. The lower half is red, and so the whole column becomes red."""

    class Halves(StandInAvatar):
        def colour(self, points_m: Tensor, directions: Tensor, theta: Tensor, root: Tensor) -> Tensor:
            return torch.where(points_m[:, 2:] < 0.85, torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]))

    clothes = upright_column(0.16, 0.0, 1.6)
    texels, posed = texels_of(clothes), dressed(UPRIGHT, clothes)
    z_m = clothes.triangles_center[texels.face, 2]
    for cavities, above in ((no_cavities(posed), [0, 1, 0]), (clothes.vertices[:, 2] > 0.75, [1, 0, 0])):
        colours = field_colours(Halves(UPRIGHT), posed, texels, cavities)
        np.testing.assert_allclose(np.median(colours[z_m > 0.9], 0), above, atol=1e-3)
        np.testing.assert_allclose(np.median(colours[z_m < 0.7], 0), [1, 0, 0], atol=1e-3)


def test_median_over_the_poses_that_see_a_texel() -> None:
    nan = np.nan
    poses = np.array([[3.0, nan, nan, nan], [1.0, 4.0, 7.0, nan], [2.0, 1.0, nan, nan]])[..., None] * np.ones(3)
    np.testing.assert_array_equal(median_of_seen(poses)[:, 0], [2, 2.5, 7, nan])


def test_unknown_colours_are_interpolated_over_the_mesh() -> None:
    """The column is black below 0.4 m and white above 1.2 m. In between, the harmonic function of a column is linear in
    height."""
    column = upright_column(0.15, 0.0, 1.6)
    rig, texels = clothed_rig(column_rig(), column), middles_of(len(column.faces))
    z_m = column.triangles_center[:, 2]
    colours = np.select([z_m < 0.4, z_m > 1.2], [0.0, 1.0], np.nan)[:, None] * np.ones(3)
    result = filled(colours, texels, rig)
    between = (z_m > 0.4) & (z_m < 1.2)
    assert between.sum() > 100
    assert result[between, 0] == pytest.approx((z_m[between] - 0.4) / 0.8, abs=0.01)
    np.testing.assert_array_equal(result[~between], colours[~between])


def test_a_component_without_any_colour_takes_the_mean() -> None:
    near = upright_column(0.15, 0.0, 1.6)
    rig = clothed_rig(column_rig(), twice(near, (1.0, 0, 0)))
    colours = np.full((len(rig.faces), 3), np.nan)
    colours[: len(near.faces)] = (0.2, 0.4, 0.6)
    result = filled(colours, middles_of(len(colours)), rig)
    np.testing.assert_allclose(result, [[0.2, 0.4, 0.6]] * len(colours), atol=1e-6)

"""Textures of the bending column, baked from images of it: uniformly grey, lit from the left, while it turns."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from hnerf.asset.baking import CAVITY_BRIGHTNESS, baked_textures, photographed_frames
from hnerf.asset.light import Light
from hnerf.asset.srgb import to_linear, to_srgb
from hnerf.asset.tangents import unit
from hnerf.asset.texture import rasterise, unwrap
from hnerf.body.descriptor import normals_of
from hnerf.capture.capture import Capture
from hnerf.config import AssetSettings
from hnerf.geometry.rays import cast, mesh_on_cpu
from tests.asset import figure
from tests.asset.stand_in import StandInAvatar

SUN = Light(np.array([0.7, 0, 0, -0.26, 0, 0, 0, 0, 0]), 0.0)  # E = 0.7 - 0.3 x
GREY = 0.4
SETTINGS = AssetSettings(texture_poses=1, photograph_frames=3)


@dataclass
class Grey(StandInAvatar):
    def colour(self, points_m: Tensor, directions: Tensor, theta: Tensor, root: Tensor) -> Tensor:
        shown = to_srgb(GREY * SUN.irradiance(-directions.double().numpy()))
        return torch.from_numpy(np.repeat(shown[:, None], 3, 1)).float()


@pytest.fixture(scope="module")
def pictures() -> dict[int, np.ndarray]:
    """Return an image of the column in each frame."""
    body, camera, found = figure.bending_body(), figure.side_camera(), {}
    faces = body.rig.faces.numpy()
    for frame, surface_m in zip(body.frames, body.vertices_m().double().numpy(), strict=True):
        hits = cast(mesh_on_cpu(surface_m, faces), *camera.rays(camera.pixels_px.reshape(-1, 2)))
        normals = unit(hits.interpolate(normals_of(surface_m, faces), faces))
        light = np.zeros(len(hits.face))
        light[hits.face >= 0] = to_srgb(GREY * SUN.irradiance(normals))
        picture = np.round(255 * light).astype(np.uint8).reshape(camera.height_px, camera.width_px, 1)
        found[frame] = np.repeat(picture, 3, 2)
    return found


@dataclass(frozen=True)
class Pictured(Capture):
    pictures: dict[int, np.ndarray] = dataclasses.field(default_factory=dict)

    def image(self, camera: str, frame: int) -> np.ndarray:
        return self.pictures[frame]


def test_the_albedo_of_a_uniform_column_is_uniform(pictures: dict[int, np.ndarray]) -> None:
    """The light is scaled so that E is 1 at the brightest point."""
    body = figure.bending_body()
    surfaces_m = body.vertices_m().double().numpy()
    layout = unwrap(body.rig.vertices_m.numpy(), body.rig.faces.numpy(), 64)
    capture = Pictured(**vars(figure.capture()), pictures=pictures)
    texture, albedo, _ = baked_textures(
        capture, Grey(body), body, surfaces_m, layout, 64, SETTINGS, figure.no_cavities(body), {}
    )
    assert albedo is not None
    light = albedo.light.coefficients / albedo.light.coefficients[0]
    np.testing.assert_allclose(light, SUN.coefficients / 0.7, atol=0.03)
    captured, without = (to_linear(np.percentile(picture, [5, 50, 95]) / 255) for picture in (texture, albedo.texture))
    assert captured[2] > 2 * captured[0]
    np.testing.assert_allclose(without, GREY, atol=0.03)


def test_the_field_fills_what_no_photograph_shows(pictures: dict[int, np.ndarray]) -> None:
    """A photograph of one frame shows at most the half of the column that faces the camera, and no cap from above."""
    body = figure.bending_body()
    surfaces_m = body.vertices_m().double().numpy()
    layout = unwrap(body.rig.vertices_m.numpy(), body.rig.faces.numpy(), 64)
    capture = Pictured(**vars(figure.capture()), pictures=pictures)
    settings = SETTINGS.model_copy(update={"photograph_frames": 1})
    *_, filled = baked_textures(
        capture, Grey(body), body, surfaces_m, layout, 64, settings, figure.no_cavities(body), {}
    )
    (frame,), faces, texels = photographed_frames(capture, 1, 64), body.rig.faces.numpy(), rasterise(layout, 64)
    corners_m = surfaces_m[body.index(frame)][faces]
    normals = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    away = (normals * (figure.side_camera().centre_m - corners_m.mean(1))).sum(1) < 0
    white = filled.mask[texels.row, texels.column] == 255
    assert filled.share == white.mean() and 0.5 < filled.share < 0.9
    assert (filled.mask == 255).sum() == white.sum()
    assert white[away[texels.face]].mean() > 0.95 and white[~away[texels.face]].mean() < 0.6


def test_there_is_no_albedo_without_photographs() -> None:
    body = figure.bending_body()
    layout = unwrap(body.rig.vertices_m.numpy(), body.rig.faces.numpy(), 64)
    settings = SETTINGS.model_copy(update={"photograph_frames": 0})
    texture, albedo, filled = baked_textures(
        figure.capture(), Grey(body), body, np.zeros(0), layout, 64, settings, figure.no_cavities(body), {}
    )
    assert albedo is None and texture.shape == (64, 64, 3) and filled.share == 1


def test_cavities_are_dark(pictures: dict[int, np.ndarray]) -> None:
    """The upper half of the column is marked as a cavity."""
    body = figure.bending_body()
    vertices_m, faces = body.rig.vertices_m.numpy(), body.rig.faces.numpy()
    surfaces_m, layout = body.vertices_m().double().numpy(), unwrap(vertices_m, faces, 64)
    capture = Pictured(**vars(figure.capture()), pictures=pictures)
    texels = rasterise(layout, 64)
    z_m = vertices_m[faces[texels.face]][..., 2]
    for photographs in (0, 3):
        settings, shown = SETTINGS.model_copy(update={"photograph_frames": photographs}), []
        for cavities in (figure.no_cavities(body), vertices_m[:, 2] > 0.85):
            texture, *_ = baked_textures(capture, Grey(body), body, surfaces_m, layout, 64, settings, cavities, {})
            shown.append(texture[texels.row, texels.column, 0].astype(float))
        ratio = shown[1] / shown[0]
        assert np.median(ratio[z_m.min(1) > 0.85]) == pytest.approx(CAVITY_BRIGHTNESS, abs=0.05)
        np.testing.assert_allclose(ratio[z_m.max(1) < 0.6], 1, atol=0.02)


def test_both_looks_have_plain_eyelids(pictures: dict[int, np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    body, units_m = figure.bending_body(), {"eyeBlinkLeft": np.zeros((1, 3))}
    layout = unwrap(body.rig.vertices_m.numpy(), body.rig.faces.numpy(), 64)
    capture = Pictured(**vars(figure.capture()), pictures=pictures)

    def black(colours: np.ndarray, *given: object) -> np.ndarray:
        assert given[-1] is units_m
        return 0 * colours

    monkeypatch.setattr("hnerf.asset.baking.with_plain_lids", black)
    texture, albedo, _ = baked_textures(
        capture,
        Grey(body),
        body,
        body.vertices_m().double().numpy(),
        layout,
        64,
        SETTINGS,
        figure.no_cavities(body),
        units_m,
    )
    assert albedo is not None and not texture.any() and not albedo.texture.any()


def test_many_cameras_or_a_large_texture_take_fewer_frames() -> None:
    """With 64 cameras, 2^29 texels are 8 photographs each of 1024 px, and half of one of 4096 px."""
    capture = dataclasses.replace(
        figure.capture(), train_cameras=tuple(f"{k}" for k in range(64)), train_frames=tuple(range(100))
    )
    assert [len(photographed_frames(capture, 16, side_px)) for side_px in (512, 1024, 4096)] == [16, 8, 1]

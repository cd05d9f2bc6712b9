"""The asset's textures, from the field's colours and the training photographs: with the recording's light and without
it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hnerf.asset.albedo import Albedo, AlbedoBlend, mean_irradiance
from hnerf.asset.eyelids import with_plain_lids
from hnerf.asset.field_colours import field_colours
from hnerf.asset.light import fit_light
from hnerf.asset.photographs import CapturedBlend, SeenSurface, photographed_texels, sampled
from hnerf.asset.shading import photographed_shading
from hnerf.asset.texture import Texels, UvLayout, rasterise, texture_image
from hnerf.avatar.avatar import Avatar
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.config import AssetSettings
from hnerf.evenly_spaced import evenly_spaced
from hnerf.render.motion import select_poses
from hnerf.side_by_side import side_by_side

LEAST_FIELD_PX = 256  # side of the field's texture; charts lie a few texels apart
MOST_TEXELS = 1 << 29  # of all photographs together: what they show is kept, about 4 bytes each
CAVITY_BRIGHTNESS = 0.3  # factor of sRGB values


@dataclass(frozen=True)
class Filled:
    """The texels that no photograph shows, so that the field fills them. mask (H, W) uint8: 255 there, 0 elsewhere;
    share: of all texels in charts."""

    mask: np.ndarray
    share: float

    @classmethod
    def of(cls, texels: Texels, unseen: np.ndarray, texture_px: int) -> "Filled":
        """Return the mask of texels unseen (N,) bool."""
        mask = np.zeros((texture_px, texture_px), np.uint8)
        mask[texels.row, texels.column] = 255 * unseen
        return cls(mask, float(unseen.mean()))


def baked_textures(
    capture: Capture,
    avatar: Avatar,
    clothed: BodyFit,
    surfaces_m: np.ndarray,
    layout: UvLayout,
    texture_px: int,
    settings: AssetSettings,
    cavities: np.ndarray,
    face_units_m: Mapping[str, np.ndarray],
) -> tuple[np.ndarray, Albedo | None, Filled]:
    """Return the texture of the clothed body, (H, W, 3) uint8 sRGB, its albedo, None if the texture is the field's
    alone, and what the field fills.

    surfaces_m (n, V, 3): the body's surface in the world in each frame; texture_px: side of the texture; cavities (V,)
    bool: vertices deep inside mouth and nose, which are darkened because little light reaches them; face_units_m: how
    expressions move the vertices (V, 3), by name, from which the eyelids are known.
    """
    texels, faces = rasterise(layout, texture_px), clothed.rig.faces.numpy()
    lit = texels.interpolate(np.where(cavities, CAVITY_BRIGHTNESS, 1.0)[:, None], faces)
    posed = select_poses(clothed, tuple(evenly_spaced(capture.train_frames, settings.texture_poses)))

    def finished(colours: np.ndarray) -> np.ndarray:
        shown = with_plain_lids(colours, texels, clothed.rig, face_units_m)
        return texture_image(texels, shown * lit, texture_px)

    if not settings.photograph_frames:
        field = field_colours(avatar, posed, texels, cavities)
        filled = Filled.of(texels, np.ones(len(field), bool), texture_px)
        return finished(field), None, filled
    field = _coarse_field_colours(avatar, posed, layout, texels, texture_px, cavities)
    frames = photographed_frames(capture, settings.photograph_frames, texture_px)
    photographed = {frame: SeenSurface.of(surfaces_m[clothed.index(frame)], faces) for frame in frames}
    light = fit_light(photographed_shading(capture, avatar.gains, photographed))
    seen_by_field = [surfaces_m[clothed.index(frame)] for frame in posed.frames]
    captured = CapturedBlend(field)
    albedo = AlbedoBlend(field, mean_irradiance(light, seen_by_field, faces, texels), light)
    for seen in photographed_texels(capture, avatar.gains, photographed, texels):
        captured.add(seen)
        albedo.add(seen)
    blends: list[CapturedBlend | AlbedoBlend] = [captured, albedo]
    texture, delit = side_by_side(lambda blend: finished(blend.colours()), blends)
    return texture, Albedo(delit, light), Filled.of(texels, captured.unseen, texture_px)


def photographed_frames(capture: Capture, most: int, texture_px: int) -> list[int]:
    """Return the training frames whose photographs make the texture: fewer than `most` if cameras are so many, or the
    texture so large, that they would take gigabytes."""
    affordable = MOST_TEXELS // (texture_px**2 * len(capture.train_cameras))
    return evenly_spaced(capture.train_frames, min(most, max(1, affordable)))


def _coarse_field_colours(
    avatar: Avatar, posed: BodyFit, layout: UvLayout, texels: Texels, texture_px: int, cavities: np.ndarray
) -> np.ndarray:
    """Return the field's colours at a texture's texels, (N, 3), sampled from a smaller texture: the field has less
    detail than the photographs that it is blended with."""
    side_px = min(texture_px, max(LEAST_FIELD_PX, texture_px // 2))
    coarse = rasterise(layout, side_px)
    image = texture_image(coarse, field_colours(avatar, posed, coarse, cavities), side_px)
    at = np.stack([texels.column, texels.row], 1)
    return sampled(image, (at + 0.5) * side_px / texture_px - 0.5)

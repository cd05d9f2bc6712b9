"""The asset's texture: the field's colours, and what the training photographs show."""

import numpy as np

from hnerf.asset.field_colours import field_colours
from hnerf.asset.photographs import colours_from_photographs
from hnerf.asset.texture import UvLayout, rasterise, texture_image
from hnerf.avatar.avatar import Avatar
from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.config import AssetSettings
from hnerf.evenly_spaced import evenly_spaced
from hnerf.render.motion import select_poses


def baked_texture(
    capture: Capture,
    avatar: Avatar,
    clothed: BodyFit,
    surfaces_m: np.ndarray,
    layout: UvLayout,
    settings: AssetSettings,
) -> np.ndarray:
    """Return the texture of the clothed body, (H, W, 3) uint8 sRGB. surfaces_m (n, V, 3): its surface in the world in
    each frame."""
    texels = rasterise(layout, settings.texture_px)
    posed = select_poses(clothed, tuple(evenly_spaced(capture.train_frames, settings.texture_poses)))
    colours = field_colours(avatar, posed, texels)
    if settings.photograph_frames:
        frames = evenly_spaced(capture.train_frames, settings.photograph_frames)
        photographed = {frame: surfaces_m[clothed.index(frame)] for frame in frames}
        faces = clothed.rig.faces.numpy()
        colours = colours_from_photographs(capture, avatar.gains, photographed, faces, texels, colours)
    return texture_image(texels, colours, settings.texture_px)

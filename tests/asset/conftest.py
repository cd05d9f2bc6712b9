import dataclasses

import numpy as np
import pytest

from hnerf.asset.rig_transfer import clothed_rig
from hnerf.asset.staging import StagedAvatar, stage_avatar
from hnerf.asset.texture import unwrap
from tests.asset.figure import bending_body, upright_column


@pytest.fixture(scope="session")
def staged() -> StagedAvatar:
    """Return clothes around the bending column, with a texture of noise."""
    body = bending_body()
    clothes = upright_column(0.18, -0.05, 1.65)
    layout = unwrap(clothes.vertices, clothes.faces, 64)
    clothed = dataclasses.replace(body, rig=clothed_rig(body.rig, clothes))
    return stage_avatar(clothed, layout, np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8), "z")

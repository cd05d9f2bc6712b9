import numpy as np
import trimesh

from hnerf.asset.eyelids import BLINKS, BROWS, with_plain_lids
from hnerf.asset.rig_transfer import clothed_rig
from hnerf.asset.texture import Texels
from tests.asset.figure import column_rig

RED, BLACK, BLUE = np.eye(3)[0], np.zeros(3), np.eye(3)[2]
COLUMNS = 12


def test_a_lid_that_unfolds_has_the_colour_of_plain_skin_and_not_of_the_brow() -> None:
    """Eleven squares of 1 m in a row are a face; its upper vertices 3 to 6 rise by 2 m as the eyes close, and 9 moves
    with the brow. All faces at vertices 4 and 5 then have three times the area, and those at vertices 0 and 1, and
    from 8 on, the same."""
    x, y = np.meshgrid(np.arange(COLUMNS), np.arange(2))
    k = np.arange(COLUMNS - 1)
    lower = np.stack([k, k + 1, k + 1 + COLUMNS], 1)
    upper = np.stack([k, k + 1 + COLUMNS, k + COLUMNS], 1)
    strip = trimesh.Trimesh(np.stack([x, y, 0 * x], -1).reshape(-1, 3), [*lower, *upper], process=False)
    units_m = {name: np.zeros((2 * COLUMNS, 3), np.float32) for name in (*BLINKS, *BROWS)}
    units_m["eyeBlinkLeft"][COLUMNS + np.arange(3, 7), 1] = 2
    units_m["browInnerUp"][COLUMNS + 9, 2] = 0.01
    count = len(strip.faces)
    texels = Texels(*np.zeros((2, count), int), np.arange(count), np.full((count, 3), 1 / 3, np.float32))
    square = np.tile(k, 2)
    photographed = np.tile(RED, (count, 1))
    photographed[(square >= 3) & (square <= 5)], photographed[square == 8] = BLACK, BLUE
    shown = with_plain_lids(photographed, texels, clothed_rig(column_rig(), strip), units_m)
    np.testing.assert_allclose(shown[square == 4], [RED, RED], atol=1e-6)
    outside = np.isin(square, [0, 8, 9, 10])
    np.testing.assert_array_equal(shown[outside], photographed[outside])
    bare = with_plain_lids(photographed, texels, clothed_rig(column_rig(), strip), {})
    np.testing.assert_array_equal(bare, photographed)

"""How stages after segmentation treat views whose masks were dropped."""

from pathlib import Path

import torch

from hnerf.body.fit import _outlines, _silhouette_iou
from hnerf.capture.masks import Masks
from hnerf.geometry.reach import everywhere
from hnerf.training.distributed import Distributed
from hnerf.training.gather import gather_pixels
from tests.training.scene import record

ALONE = Distributed(0, 1, torch.device("cpu"))


def test_fit_and_training_do_without_dropped_masks(tmp_path: Path) -> None:
    capture, whole, body = record(tmp_path)
    masks = Masks({view: png for view, png in whole.encoded.items() if view != ("1", 0) and view[1] != 1}, {})

    scale_m = torch.full((4, 3), 0.01, dtype=torch.float64)
    edges = _outlines(capture, masks, scale_m, 0.03)
    assert [[edge is None for edge in row] for row in edges] == [[False, True, False, False], [True] * 4, [False] * 4]

    iou = _silhouette_iou(capture, masks, body)
    assert iou == [1.0, None, 1.0]

    pixels, all_pixels = (gather_pixels(capture, m, body, everywhere, {}, tmp_path, ALONE) for m in (masks, whole))
    count, all_count = pixels.starts.diff().tolist(), all_pixels.starts.diff().tolist()
    assert count[1] == 0 and count[2] == all_count[2]
    first = slice(0, count[0])
    camera, all_camera = (p.cameras_and_xy(torch.arange(len(p.person)))[0] for p in (pixels, all_pixels))
    assert sorted(set(camera[first].tolist())) == [0, 2, 3]
    assert count[0] == int((all_camera[: all_count[0]] != 1).sum())

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from hnerf.avatar.avatar import Rendering
from hnerf.capture.capture import read_rgb, read_rgba, write_image
from hnerf.errors import InputError
from hnerf.evaluation import images as module
from hnerf.evaluation.ground_truth import GroundTruth
from hnerf.evaluation.images import mean_of, render, rgba, score_split
from hnerf.evaluation.views import View
from tests.evaluation.ball import BallAvatar, ball_fit, write_ball_capture, write_ball_truth


def test_renderings_are_rgba_with_colour_over_black(tmp_path: Path) -> None:
    """One pixel is half covered by red, one fully by black hair. A viewer that ignores alpha shows them over black."""
    alpha = torch.tensor([[0.5, 1.0]])
    picture = rgba(Rendering(torch.tensor([[[0.5, 0.0, 0.0], [0.0, 0.0, 0.0]]]), alpha, alpha))
    assert picture.tolist() == [[[128, 0, 0, 128], [0, 0, 0, 255]]]
    write_image(tmp_path / "a.png", picture)
    assert np.array_equal(read_rgba(tmp_path / "a.png"), picture)
    assert np.array_equal(read_rgb(tmp_path / "a.png"), picture[..., :3])
    stored = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert stored is not None and stored[0, 0].tolist() == [0, 0, 128, 128]  # BGRA


def test_a_rendering_with_nan_is_not_scored_as_black() -> None:
    alpha = torch.ones(1, 2)
    with pytest.raises(InputError, match=r"renders NaN; train it with another training\.seed"):
        rgba(Rendering(torch.full((1, 2, 3), torch.nan), alpha, alpha))


def test_means_skip_unknown_values_but_include_zeros() -> None:
    """A rendering that misses the person altogether has a mask_iou of 0."""
    assert mean_of([0.0, None, 0.5, 1.0]) == 0.5
    assert mean_of([None]) is None


def test_an_image_without_alpha_is_refused_as_a_rendering(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(InputError, match=r"a\.png: no readable image with an alpha channel"):
        read_rgba(tmp_path / "a.png")


def test_images_without_the_person_are_counted_but_not_scored(tmp_path: Path) -> None:
    """In one of two images, the person has left."""
    capture = write_ball_capture(tmp_path)
    write_ball_truth(capture)
    write_image(tmp_path / "ground_truth" / "masks" / "c" / "000001.png", np.zeros((64, 64, 3), np.uint8))
    views = [View("novel_view", "c", frame) for frame in (0, 1)]
    render({"novel_view": BallAvatar(ball_fit())}, capture, views, tmp_path)
    found = score_split("novel_view", views, GroundTruth(tmp_path, capture), tmp_path)
    assert (found["n"], found["without_person"], found["without_mask"]) == (1, 1, 0)
    assert [row["frame"] for row in found["per_image"]] == [0]


def test_rendering_time_is_per_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two images take 12 s."""
    capture = write_ball_capture(tmp_path)
    clock = iter((100.0, 112.0))
    monkeypatch.setattr(module.time, "perf_counter", lambda: next(clock))
    monkeypatch.setattr(module, "tracked", lambda items, *_: items)  # which reads the clock too
    views = [View("novel_view", "c", frame) for frame in (0, 1)]
    assert render({"novel_view": BallAvatar(ball_fit())}, capture, views, tmp_path) == 6.0

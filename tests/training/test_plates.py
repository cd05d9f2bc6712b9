from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from hnerf.capture.masks import Masks
from hnerf.training.plates import BESIDE_PX, plates_of

HEIGHT_PX, WIDTH_PX, SIDE_PX = 24, 90, 10


def recording(columns: list[int], clean: np.ndarray | None = None) -> tuple[Any, Masks]:
    """Return a capture and its masks: a bright square in front of a gradient, whose left edge is at the given column in
    each frame."""
    images, masks = {}, {}
    for frame, column in enumerate(columns):
        mask = np.zeros((HEIGHT_PX, WIDTH_PX), bool)
        mask[7 : 7 + SIDE_PX, column : column + SIDE_PX] = True
        masks["01", frame] = cv2.imencode(".png", 255 * mask.astype(np.uint8))[1].tobytes()
        images[frame] = np.where(mask[..., None], 250, background()).astype(np.uint8)
    capture = SimpleNamespace(
        train_cameras=("01",), background=lambda name: clean, image=lambda name, frame: images[frame]
    )
    return capture, Masks(masks, {})


def background() -> np.ndarray:
    return np.broadcast_to(np.arange(WIDTH_PX)[None, :, None], (HEIGHT_PX, WIDTH_PX, 3)).astype(np.uint8)


def test_a_walking_person_uncovers_the_whole_background() -> None:
    (plate,) = plates_of(*recording([20, 60]), (0, 1)) or []
    assert plate.known.all()
    np.testing.assert_array_equal(plate.colour, background())


def test_background_hidden_in_all_frames_is_unknown() -> None:
    """The square covers columns 20 to 29, then 34 to 43: columns 29 to 34 are within 5 px of it in both frames."""
    (plate,) = plates_of(*recording([20, 34]), (0, 1)) or []
    hidden = np.flatnonzero(~plate.known.all(0))
    assert hidden.tolist() == list(range(34 - BESIDE_PX, 30 + BESIDE_PX))
    np.testing.assert_array_equal(plate.colour[plate.known], background()[plate.known])


def test_a_person_who_stands_still_leaves_no_plate() -> None:
    assert plates_of(*recording([20, 21]), (0, 1)) is None
    assert plates_of(*recording([20]), (0,)) is None


def test_there_is_no_plate_if_most_of_the_outline_is_never_uncovered() -> None:
    """With squares six columns apart, columns 21 to 34 are never free. Of an outline of 80 px, two columns of 12 px are
    free: 30 %."""
    assert plates_of(*recording([20, 26]), (0, 1)) is None


def test_a_recorded_clean_plate_is_used_unchanged() -> None:
    clean = np.full((HEIGHT_PX, WIDTH_PX, 3), 7, np.uint8)
    (plate,) = plates_of(*recording([20], clean), (0,)) or []
    assert plate.known.all() and plate.colour is clean


def test_a_camera_without_masks_has_no_plate() -> None:
    assert plates_of(*recording([20, 60]), (5,)) is None

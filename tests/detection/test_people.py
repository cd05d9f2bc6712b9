"""How the subject and other people are handled: masks, figures, and subjects that cannot be used."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from hnerf.capture.capture import Capture, read_rgb, write_image
from hnerf.capture.people import PersonTrack
from hnerf.detection.people import check_subject, draw_people, keep_subject, people_rows
from hnerf.errors import InputError
from tests.calibration.synthetic import ring, write_capture

SIZE_PX = 100


def standing(x: float, height_px: float = 90.0) -> np.ndarray:
    """Return keypoints (25, 3) on a line from (x, 5) downwards."""
    return np.column_stack([np.full(25, x), np.linspace(5, 5 + height_px, 25), np.full(25, 0.9)])


def track(*images: np.ndarray, moves: bool = True) -> PersonTrack:
    """Return the track of a person seen by one camera, from keypoints of each image."""
    return PersonTrack(np.stack(images)[None], 0.5, moves)


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """Return a capture of one camera with 100 x 100 px and two grey frames."""
    camera = dataclasses.replace(ring(1)[0], width_px=SIZE_PX, height_px=SIZE_PX)
    found = write_capture(tmp_path, [camera], np.zeros((1, 2, 25, 3)))
    for frame in found.frames:
        write_image(tmp_path / "images" / "c0" / f"{frame:06d}.png", np.full((SIZE_PX, SIZE_PX, 3), 90, np.uint8))
    return found


def test_a_pixel_belongs_to_the_person_with_the_higher_mask_value(capture: Capture, tmp_path: Path) -> None:
    """Both masks cover the image. The other person's has 200 of 255 on its right half, the subject's has 150
    everywhere. In the second image the other person is alone, so no mask is stored. Masks of an earlier image come
    first."""
    masks = np.full((4, 256, 256), 255, np.uint8)
    masks[2] = 0
    masks[2, :, 128:], masks[3] = 200, 150
    regions = np.tile([49.5, 49.5, 100.0, 0.0], (2, 2, 1))
    people = np.stack([[standing(75), standing(25)], [standing(75), 0 * standing(25)]])
    subject = np.stack([standing(25), 0 * standing(25)])
    keep_subject(
        tmp_path, capture, "c0", subject, people, {"masks": masks, "mask_rows": np.array([2, 4]), "regions": regions}
    )
    first, second = (
        cv2.imread(str(tmp_path / "person" / "c0" / f"00000{k}.png"), cv2.IMREAD_GRAYSCALE) for k in (0, 1)
    )
    assert first is not None and second is not None
    assert first[50, [10, 45]].tolist() == [150, 150] and first[50, [55, 90]].tolist() == [0, 0]
    assert second.max() == 0


def test_the_mask_is_unchanged_if_the_subject_is_alone(capture: Capture, tmp_path: Path) -> None:
    people, found = np.stack([[standing(25)]] * 2), {"regions": np.ones((2, 1, 4))}
    keep_subject(tmp_path, capture, "c0", people[:, 0], people, found)
    assert not (tmp_path / "person").exists()


def test_figures_list_the_subject_and_the_people_left_out() -> None:
    rows = people_rows([track(standing(25), standing(30)), track(standing(75, 40), 0 * standing(0), moves=False)])
    assert rows == [
        {"person": "subject", "cameras": 1, "images": 2, "height_px": 90.0, "moves": True, "claim": 0.5},
        {"person": "left 1", "cameras": 1, "images": 1, "height_px": 40.0, "moves": False, "claim": 0.5},
    ]


def test_the_overview_draws_the_subject_green_and_others_red(capture: Capture, tmp_path: Path) -> None:
    """The overview is 360 px high: the subject's line at 25 of 100 px is drawn at 90 px, the other's at 270 px."""
    draw_people(
        tmp_path / "people.png", capture, [track(standing(25), standing(25)), track(standing(75), standing(75))]
    )
    picture = read_rgb(tmp_path / "people.png")
    assert picture.shape == (360, 360, 3)
    assert picture[180, 90].tolist() == [0, 200, 0] and picture[180, 270].tolist() == [220, 0, 0]


def test_a_person_who_is_too_small_is_refused(capture: Capture) -> None:
    """Larger images help only if the recording has them."""
    check_subject(capture, track(standing(25, 80), standing(25, 80)))
    small, larger = track(standing(25, 79), standing(25, 79)), ", or raise capture.max_side_px in `hnerf run`"
    for recorded_px, also in ((SIZE_PX, ""), (2 * SIZE_PX, larger)):
        as_recorded = dataclasses.replace(capture, recorded_sizes_px={"c0": (recorded_px, recorded_px)})
        with pytest.raises(InputError) as refused:
            check_subject(as_recorded, small)
        needed = "ring: the person is 79 px tall at most, and 80 are needed; record from nearer by"
        assert str(refused.value) == needed + also


def test_a_person_who_is_always_cut_off_is_refused(capture: Capture) -> None:
    """One ankle is seen in the first image and the other in the second, but never both."""
    left, right = standing(25), standing(25)
    left[11], right[14] = 0, 0
    with pytest.raises(InputError, match="ring: the person is always cut off by the images' border; record"):
        check_subject(capture, track(left, right))
    check_subject(capture, track(left, standing(25)))


def test_a_person_whom_one_camera_sees_whole_may_be_cut_off_in_another(tmp_path: Path) -> None:
    cameras = [dataclasses.replace(camera, width_px=SIZE_PX, height_px=SIZE_PX) for camera in ring(2)]
    capture = write_capture(tmp_path, cameras, np.zeros((2, 2, 25, 3)))
    cut = standing(25)
    cut[11] = 0
    check_subject(capture, PersonTrack(np.stack([[cut, cut], [standing(25), standing(25)]]), 0.5, True))

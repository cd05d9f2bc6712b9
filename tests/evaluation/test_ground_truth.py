from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hnerf.capture.capture import stored_lens, write_image
from hnerf.capture.lens import Lens
from hnerf.capture.normalise import Normaliser
from hnerf.errors import InputError
from hnerf.evaluation.ground_truth import GroundTruth
from tests.evaluation.ball import PHOTOGRAPHED, ball_mask, centre_m, write_ball_capture, write_ball_truth

MASK = "ground_truth/masks/c/000001.png"


@pytest.fixture
def truth(tmp_path: Path) -> GroundTruth:
    capture = write_ball_capture(tmp_path)
    write_ball_truth(capture)
    return GroundTruth(tmp_path, capture)


def test_without_on_black_images_the_masked_photograph_is_used(truth: GroundTruth) -> None:
    image, source = truth.on_black("c", 1)
    assert source == "image x ground-truth mask"
    assert np.array_equal(image[..., 0], ball_mask(truth.capture.cameras["c"], centre_m(1)) * PHOTOGRAPHED)


def test_on_black_images_take_precedence_and_are_resized_to_the_camera(truth: GroundTruth) -> None:
    write_image(truth.folder / "ground_truth/on_black/c/000001.jpg", np.full((128, 128, 3), 90, np.uint8))
    image, source = truth.on_black("c", 1)
    assert source == "ground_truth/on_black"
    assert np.array_equal(image, np.full((64, 64, 3), 90))


def test_a_larger_mask_is_downscaled_by_area(truth: GroundTruth) -> None:
    """Of 256 columns, those from 5 on are masked. Of the four columns that become column 1, three belong to the person
    and the first does not."""
    mask = np.zeros((256, 256), np.uint8)
    mask[:, 5:] = 255
    write_image(truth.folder / MASK, mask)
    assert truth.mask("c", 1)[0, :3].tolist() == [False, True, True]


def bent(truth: GroundTruth) -> GroundTruth:
    """Return truth of a camera with lens distortion, recorded at twice its size."""
    camera = truth.capture.cameras["c"]
    size_px = (2 * camera.width_px, 2 * camera.height_px)
    lenses = {"c": (camera.scaled(2).K.tolist(), [0.0, 0.0, 0.5, 0.5])}
    return replace(truth, capture=replace(truth.capture, recorded_sizes_px={"c": size_px}, recorded_lenses=lenses))


@pytest.mark.parametrize(("size_px", "lens"), [((100, 180), False), ((64, 128), False), ((256, 256), True)], ids=str)
def test_truth_of_another_shape_or_that_cannot_be_undistorted_is_refused(
    truth: GroundTruth, size_px: tuple[int, int], lens: bool
) -> None:
    write_image(truth.folder / MASK, np.zeros(size_px[::-1], np.uint8))
    shown = f"{size_px[0]} x {size_px[1]} px"
    with pytest.raises(InputError, match=rf"000001\.png: is {shown}, unlike camera c; give it at the recording's size"):
        (bent(truth) if lens else truth).mask("c", 1)


def test_truth_of_the_cameras_shape_or_the_recordings_size_is_accepted(truth: GroundTruth) -> None:
    """The camera has 85 x 64 px. An image of 1024 x 768 px has the same aspect ratio up to rounding."""
    wide = replace(truth.capture.cameras["c"], width_px=85)
    odd = replace(truth, capture=replace(truth.capture, cameras={**truth.capture.cameras, "c": wide}))
    write_image(truth.folder / MASK, np.full((768, 1024), 255, np.uint8))
    assert odd.mask("c", 1).all() and odd.mask("c", 1).shape == (64, 85)
    write_image(truth.folder / MASK, np.full((128, 128), 255, np.uint8))
    assert bent(truth).mask("c", 1).shape == (64, 64)


def test_truth_is_synchronised_with_the_photograph(truth: GroundTruth) -> None:
    """Camera c records the instant of frame 1 in its frame 2."""
    synchronised = replace(truth, capture=truth.capture.synchronised({"c": 1.0}))
    expected = ball_mask(truth.capture.cameras["c"], centre_m(2))
    assert np.array_equal(synchronised.mask("c", 1), expected)
    assert np.array_equal(synchronised.on_black("c", 1)[0][..., 0], expected * PHOTOGRAPHED)
    write_image(truth.folder / "ground_truth/on_black/c/000002.jpg", np.full((64, 64, 3), 90, np.uint8))
    assert synchronised.on_black("c", 1)[0].max() == 90


@pytest.mark.parametrize(("fisheye", "terms"), [(False, [0.0, 0.0, 0.5, 0.5]), (True, [5.0, 0.0, 0.0, 0.0])])
def test_truth_is_undistorted_like_photographs(truth: GroundTruth, fisheye: bool, terms: list[float]) -> None:
    """Compare with the Normaliser that ingest applies to photographs; lens distortion moves the outline."""
    camera = truth.capture.cameras["c"]
    size_px = (camera.width_px, camera.height_px)
    straight = truth.mask("c", 1)
    lens = Lens("c", camera.K, np.array(terms), np.eye(3), np.zeros(3), size_px, fisheye=fisheye)
    bent = replace(truth.capture, recorded_sizes_px={"c": size_px}, recorded_lenses={"c": stored_lens(lens)})
    found = replace(truth, capture=bent).mask("c", 1)
    expected = Normaliser.create(lens, size_px, max(size_px)).pixels(255 * straight.astype(np.uint8)) > 127
    assert np.array_equal(found, expected) and not np.array_equal(found, straight)


def test_a_missing_mask_is_known_and_reported_by_name(truth: GroundTruth) -> None:
    assert truth.has_mask("c", 1)
    (truth.folder / MASK).unlink()
    assert not truth.has_mask("c", 1)
    with pytest.raises(InputError, match=r"000001\.png"):
        truth.mask("c", 1)


@pytest.mark.parametrize(
    ("faces", "vertices", "frames", "why"),
    [
        ([[0, 1, 3]], np.zeros((1, 3, 3)), [0], "a face index is out of range"),
        ([[-1, 0, 1]], np.zeros((1, 3, 3)), [0], "a face index is out of range"),
        ([[0, 1, 2]], np.zeros((1, 3, 2)), [0], ""),
        ([[0, 1, 2]], np.zeros((3, 3)), [0], ""),
        ([[0, 1, 2, 2]], np.zeros((1, 3, 3)), [0], ""),
        ([0, 1, 2], np.zeros((1, 3, 3)), [0], ""),
        ([[0.0, 1.0, 2.0]], np.zeros((1, 3, 3)), [0], ""),
        ([[0, 1, 2]], np.full((1, 3, 3), np.nan), [0], ""),
        ([[0, 1, 2]], np.full((1, 3, 3), 2e4), [0], ""),
        ([[0, 1, 2]], np.zeros((2, 3, 3)), [np.inf, 1], "cannot convert float infinity"),
        ([{}], np.zeros((1, 3, 3)), [0], ""),  # pickled
    ],
)
def test_surfaces_that_cannot_be_compared_are_refused(
    truth: GroundTruth, faces: list, vertices: np.ndarray, frames: list[float], why: str
) -> None:
    path = truth.folder / "ground_truth" / "meshes.npz"
    np.savez(path, faces=np.array(faces), vertices=vertices, frames=np.array(frames))
    with pytest.raises(InputError, match=rf"meshes\.npz: true surfaces cannot be read \({why}"):
        truth.meshes()


def test_surfaces_that_do_not_fit_in_memory_are_refused(truth: GroundTruth, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> np.ndarray:
        raise MemoryError("Unable to allocate 1.07 PiB")

    np.savez(truth.folder / "ground_truth" / "meshes.npz", faces=np.zeros((1, 3), int))
    monkeypatch.setattr(np.lib.format, "read_array", full)
    with pytest.raises(InputError, match=r"meshes\.npz: true surfaces cannot be read \(Unable to allocate"):
        truth.meshes()

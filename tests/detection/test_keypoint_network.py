"""Keypoint networks of the user's own, made here: they answer every image with the same heatmaps or SimCC."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper

from hnerf.capture.capture import Capture
from hnerf.config import DetectionSettings
from hnerf.detection.detect import detect
from hnerf.detection.keypoint_network import KeypointNetwork, from_heatmaps, from_simcc, region_of
from hnerf.detection.landmarks import Person
from hnerf.detection.region import Region
from hnerf.errors import InputError
from tests.detection.made_up import MadeUp

WIDTH, HEIGHT = 12, 16  # of the networks' input


def write_network(path: Path, *outputs: np.ndarray, size: tuple[int | str, ...] = (HEIGHT, WIDTH)) -> Path:
    """Write a network that adds 0 times the mean of its input (1, 3, *size) to constant outputs."""
    given = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, *size])
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "nought"], ["nothing"]),
    ]
    constants = [helper.make_tensor("nought", TensorProto.FLOAT, [], [0.0])]
    for i, values in enumerate(outputs):
        constants.append(helper.make_tensor(f"values{i}", TensorProto.FLOAT, values.shape, values.ravel().tolist()))
        nodes.append(helper.make_node("Add", [f"values{i}", "nothing"], [f"found{i}"]))
    found = [helper.make_tensor_value_info(f"found{i}", TensorProto.FLOAT, None) for i in range(len(outputs))]
    graph = helper.make_graph(nodes, path.stem, [given], found, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    path.write_bytes(model.SerializeToString())
    return path


def simcc(points: int, x: int, y: int, confidence: float) -> tuple[np.ndarray, np.ndarray]:
    """Return SimCC outputs with two bins per pixel; the peak of all points is in the bins x and y."""
    across, down = np.zeros((1, points, 2 * WIDTH)), np.zeros((1, points, 2 * HEIGHT))
    across[..., x], down[..., y] = 0.9, confidence
    return across, down


def person(points_px: np.ndarray, angle: float) -> Person:
    region = Region(np.zeros(2), 1.0, angle)
    return Person(np.column_stack([points_px, np.ones(len(points_px))]), np.zeros((33, 3)), np.zeros(0), region, region)


def test_heatmaps_by_hand() -> None:
    """A Gaussian around column 2.3, row 4.8 of 12 x 9 cells, and one above 1 in a corner. An input of 45 x 34 px has
    4 px per cell."""
    y, x = np.mgrid[:12, :9]
    places = ((2.3, 4.8, 0.8), (8, 0, 1.2))
    maps = np.stack([peak * np.exp(-((x - a) ** 2 + (y - b) ** 2) / 4.5) for a, b, peak in places])
    found = from_heatmaps(maps, (33, 45))
    np.testing.assert_allclose(found[:, :2], [[4 * 2.3, 4 * 4.8], [32, 0]], atol=1e-9)
    np.testing.assert_allclose(found[:, 2], [0.8 * math.exp(-(0.3**2 + 0.2**2) / 4.5), 1])
    assert np.array_equal(from_heatmaps(np.zeros((1, 12, 9)), (33, 45)), [[0, 0, 0]])


def test_simcc_by_hand() -> None:
    """Two bins per pixel: bin 7 is x = 3.5, bin 12 is y = 6. The lower peak is the confidence, at most 1."""
    across, down = (part[0] for part in simcc(2, 7, 12, 0.6))
    across[1] *= 2
    down[1] *= 3
    np.testing.assert_allclose(from_simcc(across, down, (WIDTH, HEIGHT)), [[3.5, 6, 0.6], [3.5, 6, 1]])


@pytest.mark.parametrize(
    ("low", "high", "per_px"),
    [((100, 40), (130, 168), 10), ((80, 100), (176, 112), 10), ((110, 40), (111, 168), 10)],
    ids=["tall", "wide", "narrow"],
)
def test_a_crop_has_the_aspect_of_the_input_around_the_person(low: tuple, high: tuple, per_px: float) -> None:
    """128 px of height, times 1.25, are the 16 px of a crop's height; 96 px of width its 12 px: 10 px each."""
    region = region_of(person(np.array([low, high]), 0.0), (WIDTH, HEIGHT))
    np.testing.assert_allclose(region.centre_px, np.mean([low, high], 0))
    assert region.side_px == pytest.approx(per_px * HEIGHT)


def test_a_crop_turns_with_the_person() -> None:
    """Somebody who lies with the head to the right: upright after a quarter turn, 128 px tall."""
    region = region_of(person(np.array([[40.0, 100], [168, 110]]), math.pi / 2), (WIDTH, HEIGHT))
    np.testing.assert_allclose(region.centre_px, [104, 105])
    assert (region.side_px, region.angle) == (pytest.approx(160), math.pi / 2)


@pytest.mark.parametrize("angle", [0.0, math.pi / 2])
def test_points_are_in_pixels_of_the_image(tmp_path: Path, angle: float) -> None:
    """The person is 128 px tall, around (100, 90), so that crops have 10 px of the image per pixel. Pixel (3.5, 6) of a
    crop of 12 x 16 px, whose middle is (5.5, 7.5), is 20 px left of the middle and 15 px above."""
    network = KeypointNetwork(write_network(tmp_path / "n.onnx", *simcc(26, 7, 12, 0.6)))
    assert network.points == 26
    ends = np.array([[0.0, -64], [0, 64]]) if angle == 0 else np.array([[-64.0, 0], [64, 0]])
    found = network(np.zeros((200, 220, 3), np.uint8), person(np.add(ends, [100, 90]), angle))
    place = [80, 75, 0.6] if angle == 0 else [115, 70, 0.6]
    np.testing.assert_allclose(found, np.tile(place, (26, 1)), atol=1e-5)


def test_the_network_sees_the_crop_with_normalised_colours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An image of 1 px per pixel of the crop, with a red pixel (178, 0, 0) in row 5, column 6 of the crop."""
    seen = []
    network = KeypointNetwork(write_network(tmp_path / "n.onnx", *simcc(17, 0, 0, 1)))
    monkeypatch.setattr(network, "_decoded", lambda values: (seen.append(values), np.zeros((17, 3)))[1])
    image = np.zeros((40, 40, 3), np.uint8)
    image[15, 26] = 178, 0, 0
    network(image, person(np.array([[25.5, 17.5 - 6.4], [25.5, 17.5 + 6.4]]), 0.0))
    assert seen[0].shape == (16, 12, 3)
    mean, std = np.array([123.675, 116.28, 103.53]), np.array([58.395, 57.12, 57.375])
    np.testing.assert_allclose(seen[0][5, 6], ([178, 0, 0] - mean) / std)
    assert (np.delete(seen[0].reshape(-1, 3), 5 * 12 + 6, 0) == -mean / std).all()


def shaped(*shapes: tuple[int, ...]) -> list[np.ndarray]:
    return [np.zeros(shape) for shape in shapes]


@pytest.mark.parametrize(
    "outputs",
    [
        shaped((1, 25, 4, 3)),
        shaped((2, 17, 4, 3)),
        shaped((1, 17, 4, 1)),
        shaped((1, 17, 3)),
        shaped((1, 17, 24)),
        shaped((1, 17, 32), (1, 17, 24)),
        shaped((1, 17, 24), (1, 26, 32)),
    ],
    ids=["25 points", "two people", "one column", "coordinates", "SimCC's x alone", "y first", "other counts"],
)
def test_other_outputs_are_refused(tmp_path: Path, outputs: list[np.ndarray]) -> None:
    path = write_network(tmp_path / "n.onnx", *outputs)
    shapes = re.escape(", ".join(str(found.shape) for found in outputs))
    wanted = (
        r"n\.onnx: needs heatmaps \(1, K, h, w\) or SimCC \(1, K, 12 r\), \(1, K, 16 r\) as outputs, of 17, 26, 133"
    )
    with pytest.raises(InputError, match=rf"{wanted} points; it has {shapes}$"):
        KeypointNetwork(path)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^detection\.model: .*nowhere\.onnx: no such file; [^\n]*$"):
        KeypointNetwork(tmp_path / "nowhere.onnx")
    with pytest.raises(InputError, match=r"any\.onnx: needs one float input \(1, 3, H, W\) of fixed H and W; it has"):
        KeypointNetwork(write_network(tmp_path / "any.onnx", *simcc(17, 0, 0, 1), size=("H", "W")))
    with pytest.raises(InputError, match=r"nan\.onnx: its output is not finite; [^\n]*$"):
        KeypointNetwork(write_network(tmp_path / "nan.onnx", np.full((1, 17, 4, 3), np.nan)))


def test_its_keypoints_replace_those_of_blazepose(recording: Capture, tmp_path: Path) -> None:
    """BlazePose's points are all at (5, 4), but the right toe at (30, 4): a person 25 px wide, around (17.5, 4). So a
    crop of 12 px has 25 * 1.25 / 12 px of the image per pixel, and its pixel (3.5, 7) is 2 px left of its middle and
    0.5 px above. COCO-17 has no feet: the heel is BlazePose's."""
    model = write_network(tmp_path / "n.onnx", *simcc(17, 7, 14, 0.6))
    detect(recording, DetectionSettings(source="network", model=model), tmp_path / "out")
    keypoints = Capture.load(tmp_path / "out").keypoints("01")
    scale = 25 * 1.25 / 12
    assert keypoints is not None and keypoints.shape == (5, 1, 25, 3) and MadeUp.seen == 5
    np.testing.assert_allclose(keypoints[:, 0, :19], np.tile([17.5 - 2 * scale, 4 - 0.5 * scale, 0.6], (5, 19, 1)))
    np.testing.assert_allclose(keypoints[:, 0, [21, 24]], np.tile([5, 4, 0.5], (5, 2, 1)))
    landmarks = np.load(tmp_path / "out" / "landmarks" / "01.npz")
    assert landmarks["own_px"].shape == (5, 1, 17, 3) and landmarks["points_px"].shape == (5, 1, 33, 3)


def test_its_hands_are_those_of_the_people(recording: Capture, tmp_path: Path) -> None:
    """Of the 133 points, the last 42 are the left and the right hand's. All but the right hand's lie where the one
    above does; the right hand is 1 px of the network to the right."""
    across, down = simcc(133, 7, 14, 0.6)
    across[:, 112:] = np.roll(across[:, 112:], 2, axis=-1)
    model = write_network(tmp_path / "n.onnx", across, down)
    detect(recording, DetectionSettings(source="network", model=model), tmp_path / "out")
    hands, scale = Capture.load(tmp_path / "out").given_hands("01"), 25 * 1.25 / 12
    assert hands is not None and hands.shape == (5, 1, 2, 21, 3)
    for hand, right in enumerate((0, scale)):
        expected = np.tile([17.5 - 2 * scale + right, 4 - 0.5 * scale, 0.6], (5, 1, 21, 1))
        np.testing.assert_allclose(hands[:, :, hand], expected)


def test_a_network_that_is_sure_of_nothing_finds_nobody(recording: Capture, tmp_path: Path) -> None:
    model = write_network(tmp_path / "n.onnx", np.zeros((1, 133, 4, 3)))
    with pytest.raises(InputError, match="nobody found in any image of the training cameras"):
        detect(recording, DetectionSettings(source="network", model=model), tmp_path / "out")

"""Learned segmentation, with a network made here: the probability of a person steps up where blue - red is 0.3."""

import sys
from pathlib import Path

import numpy as np
import pytest
from onnx import NodeProto, TensorProto, helper

from hnerf.config import SegmentationSettings
from hnerf.errors import InputError
from hnerf.segmentation.learned import Network
from hnerf.segmentation.segment import segment
from tests.segmentation.scene import write_scene


def write_network(path: Path, shape: list, gain: float = 50.0) -> Path:
    """Write sigmoid(gain * (blue - red - 0.3)) as a 1 x 1 convolution; channels come last if `shape` says so."""
    first = shape[1] == 3
    names = ["image", "planes"] if first else ["turned", "planes"]
    weights = helper.make_tensor("weights", TensorProto.FLOAT, [1, 3, 1, 1], [-gain, 0.0, gain])
    bias = helper.make_tensor("bias", TensorProto.FLOAT, [1], [-0.3 * gain])
    nodes = [] if first else [helper.make_node("Transpose", ["image"], ["turned"], perm=[0, 3, 1, 2])]
    nodes += [
        helper.make_node("Conv", [names[0], "weights", "bias"], ["planes"]),
        helper.make_node("Sigmoid", ["planes"], ["person"]),
    ]
    return save(path, shape, nodes, weights, bias)


def save(path: Path, shape: list, nodes: list[NodeProto], *constants: TensorProto) -> Path:
    """Write a network with the input `image`, of this shape, and the output `person`."""
    image, seen = (
        helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in (("image", shape), ("person", None))
    )
    graph = helper.make_graph(nodes, path.stem, [image], [seen], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    path.write_bytes(model.SerializeToString())
    return path


@pytest.mark.parametrize("shape", [[1, 3, "H", "W"], [1, "H", "W", 3], [1, 3, 20, 40]])
def test_probability_by_hand(tmp_path: Path, shape: list) -> None:
    image = np.zeros((10, 20, 3), np.uint8)
    image[:, 10:] = (60, 80, 150)  # 50 * (150 - 60) / 255 - 15 = 2.647: a probability of 0.934
    found = Network(write_network(tmp_path / "n.onnx", shape)).probability(image)
    assert found.shape == (10, 20) and found.dtype == np.float32
    np.testing.assert_allclose(found[:, 12:], 0.934, atol=1e-3)
    np.testing.assert_allclose(found[:, :8], 0, atol=1e-6)


def test_the_subject_is_chosen_among_the_people_that_the_network_finds(tmp_path: Path) -> None:
    capture, truth = write_scene(tmp_path, plate=False, stranger_px=130)
    settings = SegmentationSettings(model=write_network(tmp_path / "n.onnx", [1, 3, "H", "W"]))
    masks = segment(capture, None, settings)
    assert masks.report["cameras"]["c0"]["backend"] == "learned model"
    for view, mask in truth.items():
        found = masks.get(*view)
        assert (found & mask).sum() / (found | mask).sum() > 0.97


def test_a_missing_file_and_a_missing_package_say_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"nowhere\.onnx: no such file"):
        Network(tmp_path / "nowhere.onnx")
    path = write_network(tmp_path / "n.onnx", [1, 3, "H", "W"])
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InputError, match=r"install '\.\[learned\]'"):
        Network(path)


def test_files_without_a_usable_network_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.onnx").write_text("not a network")
    with pytest.raises(InputError, match="not a network that ONNX Runtime can run"):
        Network(tmp_path / "text.onnx")
    weights = helper.make_tensor("weights", TensorProto.FLOAT, [1], [1.0])
    node = helper.make_node("Mul", ["image", "weights"], ["person"])
    flat = save(tmp_path / "flat.onnx", [1, 4], [node], weights)
    with pytest.raises(InputError, match="needs one float input"):
        Network(flat)


def test_a_network_whose_output_is_nan_is_refused(tmp_path: Path) -> None:
    """NaN is neither below 0 nor above 1, so a range check alone would miss it."""
    path = write_network(tmp_path / "n.onnx", [1, 3, "H", "W"], gain=float("nan"))
    with pytest.raises(InputError, match=r"n\.onnx: its first output must be one map of probabilities; it is .* nan"):
        Network(path).probability(np.zeros((10, 20, 3), np.uint8))


def test_a_network_that_loads_but_does_not_run_is_refused(tmp_path: Path) -> None:
    """The network declares any height and width, but runs on 4 x 4 pixels only."""
    size = helper.make_tensor("size", TensorProto.INT64, [4], [1, 3, 4, 4])
    node = helper.make_node("Reshape", ["image", "size"], ["person"])
    fixed = Network(save(tmp_path / "fixed.onnx", [1, 3, "H", "W"], [node], size))
    with pytest.raises(InputError, match=r"fixed\.onnx: does not run on \(1, 3, 10, 20\): [^\n]*any size$"):
        fixed.probability(np.zeros((10, 20, 3), np.uint8))

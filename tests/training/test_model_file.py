from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import nn

from hnerf.errors import CaptureError
from hnerf.field.encoding import FeatureGrids
from hnerf.training.model_file import fill_field, write_field


def small_field() -> nn.Module:
    """A grid of 2 x 3 x 5 nodes (x, y, z) with two features and a number."""
    field = nn.Module()
    field.grids = FeatureGrids(torch.zeros(3), torch.tensor([1.0, 2.0, 4.0]), (4,), 2)
    field.sharpness = nn.Parameter(torch.tensor(1 / 3))
    return field


def test_only_nodes_that_learned_something_are_stored(tmp_path: Path):
    """Node (x, y, z) = (1, 2, 3) is number 1 + 2 (2 + 3 x 3) = 23, the last bit of the third byte, and has its second
    feature; node 0, the first bit of the first, its first feature, which half precision rounds; the number beside them
    stays as it is."""
    learned, read = small_field(), small_field()
    learned.grids.levels[0].data[0, 1, 3, 2, 1] = -0.5
    learned.grids.levels[0].data[0, 0, 0, 0, 0] = 0.1
    path = tmp_path / "model.safetensors"
    write_field(learned, path)
    stored = load_file(path)
    assert stored["grids.levels.0.touched"].tolist() == [0b10000000, 0, 0b00000001, 0]
    torch.testing.assert_close(
        stored["grids.levels.0.features"].float(), torch.tensor([[0.1, 0], [0, -0.5]]), rtol=1e-3, atol=0
    )
    fill_field(read, stored, path)
    torch.testing.assert_close(read.grids.levels[0], learned.grids.levels[0], rtol=1e-3, atol=0)
    assert read.grids.levels[0].count_nonzero() == 2
    assert read.sharpness == learned.sharpness


@pytest.mark.parametrize("name", ["grids.levels.0.touched", "sharpness"])
def test_what_lacks_a_part_is_of_another_version(tmp_path: Path, name: str):
    path = tmp_path / "model.safetensors"
    write_field(small_field(), path)
    stored = load_file(path)
    del stored[name]
    with pytest.raises(CaptureError, match=r"model.safetensors: of another version; train the subject again"):
        fill_field(small_field(), stored, path)

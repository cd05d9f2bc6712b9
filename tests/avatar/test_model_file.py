from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import nn

from hnerf.avatar.model_file import load_field, write_field
from hnerf.errors import InputError
from hnerf.fields.sparse_grids import SparseGrids
from tests.fields.plain_grids import everywhere


def small_field(cells: int = 4) -> nn.Module:
    """Return a field with a scalar parameter and a grid of 2 x 3 x 5 nodes (x, y, z) with two features; other `cells`
    give another resolution."""
    field = nn.Module()
    field.grids = SparseGrids(torch.zeros(3), torch.tensor([1.0, 2.0, 4.0]), (cells,), 2, everywhere)
    field.sharpness = nn.Parameter(torch.tensor(1 / 3))
    return field


def written_and_read(learned: nn.Module, path: Path) -> nn.Module:
    read = small_field()
    write_field(learned, path)
    load_field(read, load_file(path), path)
    return read


def test_grid_features_are_quantised_to_a_127th_of_the_largest(tmp_path: Path):
    """With a largest feature of -12.7 the step is 0.1, so 3.14 is stored as 31 steps and 0.04 as none. The scalar is
    stored exactly."""
    learned = small_field()
    features = torch.zeros(5, 3, 2, 2)
    features[3, 2, 1, 1], features[0, 0, 0, 0], features[4, 1, 0, 0] = -12.7, 3.14, 0.04
    learned.grids.set_levels([features])
    read = written_and_read(learned, tmp_path / "model.safetensors")
    features[0, 0, 0, 0], features[4, 1, 0, 0] = 3.1, 0.0
    torch.testing.assert_close(read.grids.dense_levels(), [features])
    assert read.sharpness == learned.sharpness


def test_an_untrained_grid_is_loaded_as_zeros(tmp_path: Path):
    read = written_and_read(small_field(), tmp_path / "model.safetensors")
    assert read.grids.features.count_nonzero() == 0


def test_untrained_grid_nodes_take_almost_no_space(tmp_path: Path):
    """A tenth of 41 x 21 x 11 nodes with 2 features have random values. The file has fewer than 3 bytes for each of
    these nodes."""
    learned, path = small_field(cells=40), tmp_path / "model.safetensors"
    (nodes,) = learned.grids.dense_levels()
    nodes[:4] = torch.rand(nodes[:4].shape, generator=torch.Generator().manual_seed(0))
    learned.grids.set_levels([nodes])
    write_field(learned, path)
    assert path.stat().st_size < 3 * nodes[:4, ..., 0].numel() + 500
    assert nodes.numel() > 5 * nodes[:4].numel()


@pytest.mark.parametrize(
    "damage",
    [
        lambda stored: stored.pop("grids.levels.0.steps"),
        lambda stored: stored.pop("grids.levels.0.step"),
        lambda stored: stored.pop("sharpness"),
        lambda stored: stored.update({"grids.levels.0.steps": torch.arange(20, dtype=torch.uint8)}),
    ],
)
def test_incomplete_or_damaged_files_are_refused_as_another_version(tmp_path: Path, damage: Callable[[dict], object]):
    path = tmp_path / "model.safetensors"
    write_field(small_field(), path)
    stored = load_file(path)
    damage(stored)
    with pytest.raises(InputError, match=r"model.safetensors: written by another version; train the subject again"):
        load_field(small_field(), stored, path)


@pytest.mark.parametrize("cells", [2, 8])
def test_a_grid_of_another_size_is_refused_as_another_version(tmp_path: Path, cells: int):
    path = tmp_path / "model.safetensors"
    write_field(small_field(cells), path)
    with pytest.raises(InputError, match=r"written by another version"):
        load_field(small_field(), load_file(path), path)

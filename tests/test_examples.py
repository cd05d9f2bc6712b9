"""The scripts in examples/ run, at sizes that take seconds, and are at most 50 lines long."""

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from hnerf.capture.capture import read_rgba
from hnerf.config import SyntheticSettings

EXAMPLES = Path(__file__).parent.parent / "examples"
MOST_LINES = 50
SMALL = SyntheticSettings(size_px=48, train_cameras=3, test_cameras=0, train_frames=2, novel_pose_frames=0)
FEW = ("training.steps=4", "training.rays_per_frame=32")
COARSE = ("training.field.spacing_m=0.03", "training.field.colour_cells=[16]", "training.field.geometry_cells=[16]")


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"examples_{name}", EXAMPLES / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder that examples/train.py wrote."""
    out = tmp_path_factory.mktemp("examples") / "person"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("hnerf.fields.fast.TIGHTEN_STEP_M", 0.02)  # coarse, for the surface after four steps
        for drawn in ("cameras", "evidence"):  # drawing takes seconds
            patched.setattr(f"hnerf.calibration.report.draw_{drawn}", lambda *_: None)
        example("train").main(out, SMALL, [*FEW, *COARSE, "fit.contour_steps=1"])
    return out


def test_train_writes_the_results_of_every_stage(subject: Path) -> None:
    for file in ("capture/capture.json", "calibration/extri.yml", "fit/body.npz", "training/model.safetensors"):
        assert (subject / file).is_file()
    assert len(list((subject / "segmentation" / "masks").rglob("*.png"))) == 3 * 2
    assert json.loads((subject / "training" / "report.json").read_text())["steps"] == 4


def test_a_camera_path_passes_through_the_recorded_cameras(subject: Path, tmp_path: Path) -> None:
    example("render_path").main(subject, tmp_path, pictures=4, side_px=24)
    first, *_, last = pictures = [read_rgba(tmp_path / f"{number:06d}.png") for number in range(4)]
    assert {picture.shape for picture in pictures} == {(24, 24, 4)}
    assert all((picture[..., 3] > 0).any() for picture in pictures)
    assert np.abs(first.astype(int) - pictures[1]).max() > 0  # from another camera
    assert _overlap(first, last) > _overlap(first, pictures[1])  # the path ends where it began


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Return the IoU of the masks of two images."""
    inside_a, inside_b = a[..., 3] > 127, b[..., 3] > 127
    return float((inside_a & inside_b).sum() / max(1, (inside_a | inside_b).sum()))


def test_an_added_method_is_trained(subject: Path, tmp_path: Path) -> None:
    report = example("add_method").main(subject, tmp_path, FEW)
    assert report["steps"] == 4
    voxels = 65 * 65 * 65 * 4
    assert report["parameters"] == 2 * voxels  # only those of the grids: the networks are gone


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_examples_are_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= MOST_LINES

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from hnerf.avatar.model_file import write_field
from hnerf.avatar.trained import build_field
from hnerf.capture.formats.export import write_cameras
from hnerf.capture.lens import Lens
from tests.training.scene import TINY, record


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a column 2 m high that four cameras see from 4 m, in frames 0 to 2."""
    folder = tmp_path_factory.mktemp("subjects") / "column"
    for stage in ("capture", "calibration", "training"):
        (folder / stage).mkdir(parents=True)
    capture, _, body = record(folder / "capture")
    capture.save()
    cameras = capture.cameras.values()
    lenses = [Lens(c.name, c.K, np.zeros(5), c.R, c.t_m, c.size_px) for c in cameras]
    write_cameras(folder / "calibration", lenses, "easymocap")
    synchronised = {name: {"frame_offset": 0} for name in capture.cameras}
    (folder / "calibration" / "report.json").write_text(json.dumps({"cameras": synchronised}))
    body.save(folder / "training")
    settings = TINY.model_copy(update={"field": TINY.field.model_copy(update={"nodes": 1})})
    field = build_field(settings.field, body, False)
    field.deformation.displacement.data[:3, 0, 0] = torch.tensor([0.0, 0.15, -0.15])  # to either side, frame by frame
    write_field(field, folder / "training" / "model.safetensors")
    stored = {"static": False, "training": settings.model_dump()}
    (folder / "training" / "settings.json").write_text(json.dumps(stored))
    return folder

"""A capture with the cameras to use from calibration on. Stages that read them need none of what calibrates."""

import dataclasses
import json
from pathlib import Path

from hnerf.capture.capture import Capture, checked_capture
from hnerf.capture.formats.easymocap import read_easymocap
from hnerf.errors import InputError


def load_cameras(out: Path, capture: Capture) -> Capture:
    """Return the capture with the cameras that `CalibrationReport.save` wrote, synchronised and without rejected
    training cameras. The capture may have fewer cameras than were calibrated. Raises ValueError if the files are not
    what `save` wrote."""
    try:
        lenses = read_easymocap(out)
    except InputError as error:
        raise ValueError(error) from None
    cameras = {
        name: dataclasses.replace(capture.cameras[name], K=lens.K, R=lens.R, t_m=lens.t_m)
        for name, lens in lenses.items()
        if name in capture.cameras
    }
    train_cameras = tuple(name for name in capture.train_cameras if name in cameras)
    found = json.loads((out / "report.json").read_text())["cameras"]
    offsets = {name: found[name]["frame_offset"] for name in train_cameras if found[name]["frame_offset"]}
    used = checked_capture(dataclasses.replace(capture.with_cameras(cameras), train_cameras=train_cameras))
    return used.synchronised(offsets) if offsets else used

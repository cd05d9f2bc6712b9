"""Train from Python: from a synthetic capture to a trained person, stage by stage, without Prefect or a store.

Leaves `out/performer`, the recording, and one folder per stage, named as in `store/subjects/NAME`, so that `hnerf
render out` and the other examples can read them.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from hnerf.body.fit import fit_body
from hnerf.calibration.calibrated import load_cameras
from hnerf.calibration.check import check_calibration
from hnerf.capture.ingest import ingest
from hnerf.config import SyntheticSettings, load_settings
from hnerf.segmentation.segment import segment
from hnerf.synthetic import write_synthetic_capture
from hnerf.training.trainer import train


def main(out: Path, performer: SyntheticSettings, overrides: Sequence[str] = ()) -> float:
    """Write the recording, run every stage up to training into `out`, and return the seconds that training took."""
    settings = load_settings("demo", overrides)
    folders = {stage: out / stage for stage in ("capture", "calibration", "segmentation", "fit", "training")}
    for folder in folders.values():
        folder.mkdir(parents=True)

    write_synthetic_capture(out / "performer", performer)
    capture = ingest(out / "performer", settings.capture, folders["capture"])
    check_calibration(capture, settings.calibration).save(folders["calibration"])
    capture = load_cameras(folders["calibration"], capture)  # the same images, with the cameras to use from here on
    masks = segment(capture, None, settings.segmentation)  # None: the clean plates are enough, no body is needed
    masks.save(folders["segmentation"])
    body, _ = fit_body(capture, masks, settings.fit)
    body.save(folders["fit"])
    return train(capture, masks, body, settings.training, folders["training"])["seconds"]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    print(f"trained in {main(parser.parse_args().out, SyntheticSettings()):.0f} s")

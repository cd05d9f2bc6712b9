"""One rank of a training, as torchrun starts it.

usage: python -m hnerf.training.run CAPTURE CALIBRATION MASKS FIT SETTINGS_JSON OUT
"""

import argparse
import json
import logging
import sys
from pathlib import Path

import torch.distributed as dist

from hnerf import progress
from hnerf.body.fit_result import BodyFit
from hnerf.calibration.calibrated import load_cameras
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.config import TrainingSettings
from hnerf.errors import REASON, InputError, is_out_of_memory, one_line
from hnerf.training.distributed import Distributed
from hnerf.training.step import TrainingError
from hnerf.training.trainer import train


def main() -> int:
    """Train; return 0, or print one line that begins with REASON on standard error and return 2 for bad input, 3 for a
    training that cannot go on, 4 for failed input or output, where the line holds JSON: errno, its meaning, file; 5 for
    lack of memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("capture", "calibration", "masks", "fit"):
        parser.add_argument(name, type=Path)
    parser.add_argument("settings")
    parser.add_argument("out", type=Path)
    a = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stdout)
    try:
        processes = Distributed.join()
        capture = load_cameras(a.calibration, Capture.load(a.capture))
        settings = TrainingSettings.model_validate_json(a.settings)
        train(capture, Masks.load(a.masks), BodyFit.load(a.fit), settings, a.out, processes)
    except InputError as error:
        print(f"{REASON}{error}", file=sys.stderr)
        return 2
    except TrainingError as error:
        print(f"{REASON}{error}", file=sys.stderr)
        return 3
    except OSError as error:
        told = json.dumps([error.errno, error.strerror or one_line(error), error.filename], default=str)
        print(f"{REASON}{told}", file=sys.stderr)
        return 4
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        print(f"{REASON}{one_line(error)}; end what else takes memory, or set training.memory_gib", file=sys.stderr)
        return 5
    finally:
        progress.report("training", 1, 1)  # ended, successfully or not
        if dist.is_initialized():
            dist.destroy_process_group()
    return 0


if __name__ == "__main__":
    progress.relay()
    sys.exit(main())

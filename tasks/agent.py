"""torchrun, with a report of the first failed rank in a file: python -m tasks.agent FILE TORCHRUN'S ARGUMENTS."""

import json
import sys
from pathlib import Path

from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
from torch.distributed.run import parse_args, run

if __name__ == "__main__":
    try:
        run(parse_args(sys.argv[2:]))
    except ChildFailedError as error:
        _, failure = error.get_first_failure()
        Path(sys.argv[1]).write_text(json.dumps([failure.local_rank, failure.exitcode]))
        raise

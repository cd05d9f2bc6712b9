"""torchrun that also reports the first failed rank in a file: python -m tasks.agent FILE TORCHRUN'S ARGUMENTS."""

import json
import os
import sys
import traceback
from contextlib import suppress
from pathlib import Path

from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
from torch.distributed.run import parse_args, run

from tasks.rank import AGENT


def main(failure: Path, arguments: list[str]) -> None:
    """Run torchrun, then end this process at once. If torchrun was interrupted while it ended its ranks, some of its
    threads continue, and the interpreter would wait for them."""
    code = 1
    os.environ[AGENT] = str(os.getpid())
    try:
        run(parse_args(arguments))
        code = 0
    except BaseException as error:
        if isinstance(error, ChildFailedError):
            _, first = error.get_first_failure()
            failure.write_text(json.dumps([first.local_rank, first.exitcode]))
        with suppress(OSError):  # the caller may be gone
            traceback.print_exc()
            sys.stderr.flush()
    finally:
        os._exit(code)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])

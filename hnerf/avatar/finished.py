"""Files of a finished run that nobody has compared with their digests, as in a copy of a subject's folder."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
from safetensors import SafetensorError

from hnerf.capture.safe_io import ARRAY_FILE_ERRORS
from hnerf.errors import InputError, one_line

# SystemError: OpenCV's, of YAML that is cut. A disk's own faults (OSError) stay what they are.
DAMAGED = (*(kind for kind in ARRAY_FILE_ERRORS if kind is not OSError), SafetensorError, SystemError, cv2.error)


@contextmanager
def readable(part: Path) -> Iterator[None]:
    """Raise InputError that names this file or folder of a run if it cannot be read inside: it is cut, or another
    version's."""
    try:
        yield
    except DAMAGED as error:
        why = f"damaged, or written by another version ({one_line(error)})"
        raise InputError(f"{part}: {why}; copy the subject again, or repeat its `hnerf run`") from None

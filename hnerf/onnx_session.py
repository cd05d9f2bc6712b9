"""Networks from users' own ONNX files, run by ONNX Runtime."""

from pathlib import Path
from typing import Any

import numpy as np

from hnerf.errors import InputError, one_line


def open_session(path: Path, setting: str, threads: int = 0) -> Any:
    """Return the `onnxruntime.InferenceSession` of an ONNX file that a setting names, on this many threads, or else on
    all cores. Raises InputError if the file or ONNX Runtime is missing, or if the file is no network."""
    if not path.is_file():
        raise InputError(f"{setting}: {path}: no such file; name an ONNX file, or leave it out")
    try:
        import onnxruntime
    except ImportError:
        raise InputError(f"{setting}: {path}: needs ONNX Runtime; install '.[learned]', or leave it out") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    try:
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime's own exceptions have no common base
        raise InputError(f"{path}: not a network that ONNX Runtime can run: {one_line(error)}") from None


def outputs_of(session: Any, path: Path, values: np.ndarray, advice: str) -> list[np.ndarray]:
    """Run the network of a file on its only input; return its outputs. Raises InputError, which ends in `advice`, if it
    does not run on it."""
    try:
        return list(session.run(None, {session.get_inputs()[0].name: values}))
    except Exception as error:  # as above
        raise InputError(f"{path}: does not run on {values.shape}: {one_line(error)}; {advice}") from None

"""A network from a file of `hnerf models`, run by LiteRT on one thread."""

import numpy as np
from ai_edge_litert.interpreter import Interpreter

from hnerf.models import model_file


class Network:
    """One image in, RGB float32 (n, n, 3); several arrays out, in the order of their names."""

    def __init__(self, name: str) -> None:
        """Raises InputError where the file is missing or altered."""
        self._interpreter = Interpreter(str(model_file(name)), num_threads=1)
        self._interpreter.allocate_tensors()
        self._input = self._interpreter.get_input_details()[0]["index"]
        outputs = sorted(self._interpreter.get_output_details(), key=lambda output: output["name"])
        self._outputs = [output["index"] for output in outputs]

    def __call__(self, image: np.ndarray) -> list[np.ndarray]:
        """The outputs, without their leading axis of length 1."""
        self._interpreter.set_tensor(self._input, image[None].astype(np.float32))
        self._interpreter.invoke()
        return [self._interpreter.get_tensor(output)[0] for output in self._outputs]


def probability(logit: np.ndarray) -> np.ndarray:
    """The logistic function."""
    return 1 / (1 + np.exp(-np.clip(logit, -60, 60)))

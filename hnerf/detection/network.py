"""A network from a file of `hnerf models`, run by LiteRT on one thread."""

import numpy as np
from ai_edge_litert.interpreter import Interpreter

from hnerf.models import model_file


class Network:
    """A network with one input, an RGB image (n, n, 3) float32, and outputs in the order of their names."""

    def __init__(self, name: str) -> None:
        """Load a file of `hnerf models`. Raises PlaceError if it is missing or altered."""
        self._interpreter = Interpreter(str(model_file(name)), num_threads=1)
        self._interpreter.allocate_tensors()
        self._input = self._interpreter.get_input_details()[0]["index"]
        outputs = sorted(self._interpreter.get_output_details(), key=lambda output: output["name"])
        self._outputs = [output["index"] for output in outputs]

    def __call__(self, image: np.ndarray) -> list[np.ndarray]:
        """Run the network; return its outputs without their leading axis of length 1."""
        self._interpreter.set_tensor(self._input, image[None].astype(np.float32))
        self._interpreter.invoke()
        return [self._interpreter.get_tensor(output)[0] for output in self._outputs]


def sigmoid(logit: np.ndarray) -> np.ndarray:
    """Return the logistic function of logits of any shape."""
    return 1 / (1 + np.exp(-np.clip(logit, -60, 60)))

"""A segmentation network from a user's own ONNX file, run by ONNX Runtime."""

from pathlib import Path

import cv2
import numpy as np

from hnerf.errors import InputError
from hnerf.onnx_session import open_session, outputs_of

TOLERANCE = 1e-3  # a probability may be outside [0, 1] by this much


class Network:
    """A network with one image input and, as its first output, a map of the person's probability.

    The input is RGB in [0, 1], float32, (1, 3, H, W) or (1, H, W, 3) as the file states; if the file fixes H and W,
    images are resized to them. The output may have leading or trailing axes of length 1.
    """

    def __init__(self, path: Path) -> None:
        """Load a network. Raises InputError if the file or ONNX Runtime is missing, or if the file is no such
        network."""
        self.path, self.session = path, open_session(path, "segmentation.model")
        inputs = self.session.get_inputs()
        shape = inputs[0].shape
        if len(inputs) != 1 or len(shape) != 4 or 3 not in (shape[1], shape[3]) or inputs[0].type != "tensor(float)":
            raise InputError(f"{path}: needs one float input (1, 3, H, W) or (1, H, W, 3); it has {shape}")
        self.channels_first = shape[1] == 3
        height, width = shape[2:] if self.channels_first else shape[1:3]
        self.size_px = (width, height) if isinstance(width, int) and isinstance(height, int) else None

    def probability(self, image: np.ndarray) -> np.ndarray:
        """Return the probability of the person, (H, W) float32 in [0, 1], in an image (H, W, 3) uint8 RGB. Raises
        InputError if the output is no such map."""
        pixels = image if self.size_px is None else cv2.resize(image, self.size_px, interpolation=cv2.INTER_AREA)
        values = pixels.astype(np.float32)[None] / 255
        if self.channels_first:
            values = np.ascontiguousarray(values.transpose(0, 3, 1, 2))
        outputs = outputs_of(self.session, self.path, values, "export it for any size")
        found = np.squeeze(outputs[0])
        if found.ndim != 2 or not (found.min() >= -TOLERANCE and found.max() <= 1 + TOLERANCE):
            raise InputError(
                f"{self.path}: its first output must be one map of probabilities; it is {found.shape}, "
                f"from {found.min():.3g} to {found.max():.3g}"
            )
        return cv2.resize(found.astype(np.float32), image.shape[1::-1], interpolation=cv2.INTER_LINEAR)

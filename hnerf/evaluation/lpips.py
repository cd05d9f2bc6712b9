"""LPIPS, version 0.1 (Zhang et al. 2018): distance of deep features, by AlexNet or VGG16, each channel weighted."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from hnerf.capture.safe_pickle import read_pickle
from hnerf.models import LPIPS_ALEXNET, LPIPS_VGG, has_model, model_file

MEASURED = "version 0.1 with AlexNet, in the box of the true mask as for SSIM"
NOT_INSTALLED = "not available: its weights are not installed; `hnerf models` downloads them"
MIN_PX = 64  # smaller images are padded with black: AlexNet needs 35 px
MEAN, STD = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of RGB in [-1, 1]
EPSILON = 1e-10  # added to the norm of a feature vector, as in the published code


class Convolution(NamedTuple):
    """A convolution followed by ReLU; its features are compared if it is `tapped`."""

    stride: int
    padding: int
    tapped: bool = False


class Pool(NamedTuple):
    """A max pooling over squares of `size`, with stride 2."""

    size: int


THREE = Convolution(1, 1)
TAPPED = Convolution(1, 1, tapped=True)
ALEXNET = (Convolution(4, 2, True), Pool(3), Convolution(1, 2, True), Pool(3), TAPPED, TAPPED, TAPPED)
VGG16 = (THREE, TAPPED, Pool(2), THREE, TAPPED, Pool(2), *(THREE, THREE, TAPPED, Pool(2)) * 2, THREE, THREE, TAPPED)
NETWORKS = {LPIPS_ALEXNET: (ALEXNET, "AlexNet_0"), LPIPS_VGG: (VGG16, "VGG16_0")}


class Lpips:
    """The LPIPS distance with one backbone."""

    def __init__(self, name: str = LPIPS_ALEXNET) -> None:
        """Load the weights file `name`. Raises PlaceError if it is missing or altered."""
        self.layers, body = NETWORKS[name]
        stored = read_pickle(model_file(name))
        kinds = [layer for layer in self.layers if isinstance(layer, Convolution)]
        self.weights = [_weights(stored[body][f"Conv_{i}"]) for i in range(len(kinds))]
        self.heads = [_weights(stored[f"NetLinLayer_{i}"]["Conv_0"])[0] for i in range(sum(k.tapped for k in kinds))]

    def __call__(self, a: np.ndarray, b: np.ndarray) -> float:
        """Return the distance of two images (H, W, 3) uint8 RGB; 0 if they are equal."""
        with torch.no_grad():
            pairs = zip(self._features(a), self._features(b), self.heads, strict=True)
            return sum(float(F.conv2d((p - q) ** 2, head).mean()) for p, q, head in pairs)

    def _features(self, image: np.ndarray) -> list[torch.Tensor]:
        """Return the features (1, C, h, w) of each layer that is compared, normalised to unit length."""
        x = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None] / 127.5 - 1
        missing = [max(0, MIN_PX - side) for side in image.shape[1::-1]]
        x = F.pad(x, (0, missing[0], 0, missing[1]), value=-1.0)
        x = (x - x.new_tensor(MEAN).view(1, 3, 1, 1)) / x.new_tensor(STD).view(1, 3, 1, 1)
        weights, compared = iter(self.weights), []
        for layer in self.layers:
            if isinstance(layer, Pool):
                x = F.max_pool2d(x, layer.size, 2)
                continue
            x = F.relu(F.conv2d(x, *next(weights), stride=layer.stride, padding=layer.padding))
            if layer.tapped:
                compared.append(x / (x.norm(dim=1, keepdim=True) + EPSILON))
        return compared


def _weights(layer: dict[str, Any]) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Return kernel and bias of a layer, whose kernel is stored as (height, width, in, out)."""
    kernel = torch.from_numpy(np.array(layer["kernel"].transpose(3, 2, 0, 1), np.float32, order="C"))
    return kernel, torch.from_numpy(np.array(layer["bias"], np.float32)) if "bias" in layer else None


@cache
def _alexnet() -> Lpips:
    return Lpips()


def lpips_availability() -> str:
    """Return how LPIPS is measured on this machine, or why it is not."""
    return MEASURED if has_model(LPIPS_ALEXNET) else NOT_INSTALLED


def lpips(a: np.ndarray, b: np.ndarray) -> float | None:
    """Return the distance by AlexNet of two images (H, W, 3) uint8 RGB; None if the weights are not installed."""
    return _alexnet()(a, b) if has_model(LPIPS_ALEXNET) else None

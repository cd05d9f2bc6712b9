"""Where the recorded size is not the calibrated one: what an encoder may have done to the picture."""

import dataclasses
from collections.abc import Callable

import numpy as np

from hnerf.capture.camera import Camera

Change = Callable[[Camera, tuple[int, int], tuple[int, int]], Camera]


def _shifted(share: float) -> Change:
    """Cropped or padded, this share of the difference on the left and at the top."""

    def change(camera: Camera, calibrated_px: tuple[int, int], recorded_px: tuple[int, int]) -> Camera:
        per_recorded = camera.width_px / recorded_px[0]
        dx, dy = (share * per_recorded * (r - c) for r, c in zip(recorded_px, calibrated_px, strict=True))
        return dataclasses.replace(camera, K=np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1]]) @ camera.K)

    return change


def _stretched(camera: Camera, calibrated_px: tuple[int, int], recorded_px: tuple[int, int]) -> Camera:
    sx, sy = (r / c for r, c in zip(recorded_px, calibrated_px, strict=True))
    return dataclasses.replace(camera, K=np.diag([sx, sy, 1]) @ camera.K)


def _scaled_and_padded(camera: Camera, calibrated_px: tuple[int, int], recorded_px: tuple[int, int]) -> Camera:
    scale = min(r / c for r, c in zip(recorded_px, calibrated_px, strict=True))
    per_recorded = camera.width_px / recorded_px[0]
    dx, dy = (per_recorded * (r - scale * c) / 2 for r, c in zip(recorded_px, calibrated_px, strict=True))
    return dataclasses.replace(camera, K=np.array([[scale, 0, dx], [0, scale, dy], [0, 0, 1]]) @ camera.K)


CHANGES: dict[str, Change] = {  # none: cropped or padded on the right and at the bottom, which leaves K as it is
    "cropped or padded evenly": _shifted(0.5),
    "cropped or padded on the left or at the top": _shifted(1.0),
    "stretched": _stretched,
    "scaled and padded evenly": _scaled_and_padded,
}

"""Image sizes: what an encoder may have done if the recorded size is not the calibrated one."""

import dataclasses
from collections.abc import Callable
from functools import partial

from hnerf.capture.capture import Capture
from hnerf.geometry.camera import Camera, resampling

SizeChange = Callable[[Camera, tuple[int, int], tuple[int, int]], Camera]


def _crop_or_pad(camera: Camera, calibrated_px: tuple[int, int], recorded_px: tuple[int, int], share: float) -> Camera:
    """Return the camera of a cropped or padded image, with this share of the size difference on the left and top."""
    per_recorded = camera.width_px / recorded_px[0]
    dx, dy = (share * per_recorded * (r - c) for r, c in zip(recorded_px, calibrated_px, strict=True))
    return dataclasses.replace(camera, K=resampling(1.0, 1.0, dx, dy) @ camera.K)


def _stretch(camera: Camera, calibrated_px: tuple[int, int], recorded_px: tuple[int, int]) -> Camera:
    sx, sy = (r / c for r, c in zip(recorded_px, calibrated_px, strict=True))
    return dataclasses.replace(camera, K=resampling(sx, sy) @ camera.K)


def _scale_and_pad(camera: Camera, calibrated_px: tuple[int, int], recorded_px: tuple[int, int]) -> Camera:
    scale = min(r / c for r, c in zip(recorded_px, calibrated_px, strict=True))
    per_recorded = camera.width_px / recorded_px[0]
    dx, dy = (per_recorded * (r - scale * c) / 2 for r, c in zip(recorded_px, calibrated_px, strict=True))
    return dataclasses.replace(camera, K=resampling(scale, scale, dx, dy) @ camera.K)


# Cropping or padding on the right and at the bottom is not among them: it leaves K as it is.
SIZE_CHANGES: dict[str, SizeChange] = {
    "cropped or padded symmetrically": partial(_crop_or_pad, share=0.5),
    "cropped or padded on the left or at the top": partial(_crop_or_pad, share=1.0),
    "stretched": _stretch,
    "scaled and padded symmetrically": _scale_and_pad,
}


def size_unexplained(capture: Capture, name: str) -> bool:
    """Return whether a camera's recorded size differs from the calibrated one, and no black bars show what was done."""
    other = capture.calibrated_sizes_px[name] != capture.recorded_sizes_px[name]
    return other and name not in capture.picture_areas_px


def size_reasons(capture: Capture, name: str) -> list[str]:
    """Return, in words, what is known about a recorded size that differs from the calibrated one; empty if they are
    equal."""
    calibrated, recorded = capture.calibrated_sizes_px[name], capture.recorded_sizes_px[name]
    if calibrated == recorded:
        return []
    sizes = f"calibrated at {calibrated[0]}x{calibrated[1]}, recorded at {recorded[0]}x{recorded[1]}"
    if size_unexplained(capture, name):
        return [f"{sizes}: no black bars prove what was done to the picture"]
    area = capture.picture_areas_px[name]
    return [
        f"{sizes}: black bars prove that the picture was scaled by {area.width / calibrated[0]:.4f} and put "
        f"{area.left:.1f} px from the left and {area.top:.1f} px from the top; intrinsics changed to match"
    ]

"""Image figures of the evaluation protocol (docs/method.md): 8-bit images over black, in the person's padded box."""

from dataclasses import dataclass

import numpy as np
from skimage.metrics import structural_similarity

BOX_PADDING_PX = 20
COVERED_LEVEL = 8  # of 255; a rendered pixel brighter than this in any channel counts as person


@dataclass(frozen=True)
class ImageScore:
    """psnr in dB; ssim in [-1, 1]; mask_iou: rendered pixels that are not black against the mask, in [0, 1]."""

    psnr: float
    ssim: float
    mask_iou: float


def score_image(rendered: np.ndarray, reference: np.ndarray, mask: np.ndarray) -> ImageScore:
    """Score a rendering against a reference, both (H, W, 3) uint8 over black; mask (H, W) bool, not empty."""
    box = mask_box(mask)
    a, b = rendered[box].astype(np.float32) / 255, reference[box].astype(np.float32) / 255
    return ImageScore(psnr(a, b), ssim(a, b), mask_iou(rendered, mask))


def floors(reference: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """PSNR of who knows little: of an empty picture, and of one colour, the person's mean, in the true mask."""
    box = mask_box(mask)
    truth = reference[box].astype(np.float32) / 255
    one_colour = mask[box][..., None] * truth[mask[box]].mean(0)
    return {"empty_psnr": psnr(np.zeros_like(truth), truth), "one_colour_psnr": psnr(one_colour, truth)}


def mask_box(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of a mask's (H, W) bounding box, padded and cut to the image. The mask is not empty."""
    rows, columns = np.nonzero(mask)
    return (
        slice(max(0, int(rows.min()) - BOX_PADDING_PX), int(rows.max()) + 1 + BOX_PADDING_PX),
        slice(max(0, int(columns.min()) - BOX_PADDING_PX), int(columns.max()) + 1 + BOX_PADDING_PX),
    )


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of images in [0, 1]; 100 dB where they are equal."""
    return float(-10 * np.log10(max(1e-10, ((a - b) ** 2).mean())))


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004) of images (H, W, 3) in [0, 1]: Gaussian window of 11 px, sigma 1.5."""
    return float(
        structural_similarity(
            a, b, channel_axis=2, data_range=1, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
        )
    )


def mask_iou(rendered: np.ndarray, mask: np.ndarray) -> float:
    """Intersection over union of a rendering's (H, W, 3) uint8 lit pixels and a mask (H, W) bool."""
    lit = rendered.max(-1) > COVERED_LEVEL
    return float((lit & mask).sum() / (lit | mask).sum())

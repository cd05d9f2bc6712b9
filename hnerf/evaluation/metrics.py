"""Image metrics of the evaluation protocol (docs/method.md): 8-bit images over black, in the person's padded box."""

from typing import Any

import numpy as np
from skimage.metrics import structural_similarity

from hnerf.evaluation.lpips import lpips

BOX_PADDING_PX = 20
WINDOW_PX = 11  # of SSIM
COVERED_LEVEL = 127  # of 255; a rendered pixel with more coverage counts as person, however dark it is


def score_image(rendered: np.ndarray, reference: np.ndarray, mask: np.ndarray) -> dict[str, Any]:
    """Score a rendering (H, W, 4), over black and its coverage, against a reference (H, W, 3) over black, both uint8;
    mask (H, W) bool, not empty. The scores are those of hnerf.results.ImageScores."""
    box = mask_box(mask)
    shown, true = rendered[box][..., :3], reference[box]
    a, b = shown.astype(np.float32) / 255, true.astype(np.float32) / 255
    colour = {"psnr": psnr(a, b), "ssim": ssim(a, b)}
    return colour | {"mask_iou": mask_iou(rendered[..., 3], mask), "lpips": lpips(shown, true)}


def trivial_psnr(reference: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """Return the PSNR of trivial images: all black, and the person's mean colour inside the true mask."""
    box = mask_box(mask)
    truth = reference[box].astype(np.float32) / 255
    one_colour = mask[box][..., None] * truth[mask[box]].mean(0)
    return {"empty_psnr": psnr(np.zeros_like(truth), truth), "one_colour_psnr": psnr(one_colour, truth)}


def mask_box(mask: np.ndarray) -> tuple[slice, slice]:
    """Return rows and columns of the bounding box of a mask (H, W), padded and clipped to the image. The mask is not
    empty."""
    rows, columns = np.nonzero(mask)
    return (
        slice(max(0, int(rows.min()) - BOX_PADDING_PX), int(rows.max()) + 1 + BOX_PADDING_PX),
        slice(max(0, int(columns.min()) - BOX_PADDING_PX), int(columns.max()) + 1 + BOX_PADDING_PX),
    )


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio in dB of images in [0, 1]; 100 dB if they are equal."""
    return float(-10 * np.log10(max(1e-10, ((a - b) ** 2).mean())))


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Return the structural similarity (Wang et al. 2004) of images (H, W, 3) in [0, 1]: Gaussian window of 11 px,
    sigma 1.5. Images that are smaller than the window are padded with black."""
    missing = [(0, max(0, WINDOW_PX - side)) for side in a.shape[:2]]
    a, b = (np.pad(image, [*missing, (0, 0)]) for image in (a, b))
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return float(structural_similarity(a, b, channel_axis=2, data_range=1, **window))


def mask_iou(coverage: np.ndarray, mask: np.ndarray) -> float:
    """Return the intersection over union of a mask (H, W) bool and the pixels that a rendering covers, (H, W) uint8, by
    more than a half; 1 if there are none of either."""
    covered = coverage > COVERED_LEVEL
    union = (covered | mask).sum()
    return float((covered & mask).sum() / union) if union else 1.0

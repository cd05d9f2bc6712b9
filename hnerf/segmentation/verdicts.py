"""Checks of masks against the prior and against their neighbours in time."""

from dataclasses import dataclass

import numpy as np

from hnerf.capture.timing import median_step
from hnerf.segmentation.prior import Prior

MIN_AREA = 0.1  # of the prior's core; a smaller mask shows no person
MIN_COVERED = 0.5  # of the core
MIN_WITHIN = 0.5  # share of the mask that lies where the person can be
MAX_AREA_RATIO = 1.3  # ratio of areas between neighbours in time
NEIGHBOURS = 4  # a mask is compared with the median of this many nearest frames, at most this many median steps away


@dataclass(frozen=True)
class MaskVerdict:
    """The result of checking one mask. fault: why the mask is dropped, or None; note: a remark about it, or None;
    area_px."""

    fault: str | None
    note: str | None
    area_px: int


def judge_mask(mask: np.ndarray, prior: Prior) -> MaskVerdict:
    """Check one mask (H, W) bool by itself."""
    area_px, expected_px = int(mask.sum()), int(prior.core.sum())
    sides = [edge.any() for edge in (mask[0], mask[-1], mask[:, 0], mask[:, -1])]
    fault = None
    if area_px == 0 or area_px < MIN_AREA * expected_px:
        fault = "no person in the mask"
    elif all(sides) and mask.mean() > 0.5 and (expected_px == 0 or mask[prior.core].mean() < MIN_COVERED):
        fault = "the mask is inverted (255 must be on the person)"
    elif expected_px and mask[prior.core].mean() < MIN_COVERED:
        fault = "the mask misses the person"
    elif prior.reach.any() and mask[prior.reach].sum() < MIN_WITHIN * area_px:
        fault = "the mask is mostly not the person"
    named = [side for side, cut in zip(("top", "bottom", "left", "right"), sides, strict=True) if cut]
    return MaskVerdict(fault, f"cut off by the image's border ({', '.join(named)})" if named else None, area_px)


def area_jumps(frames: tuple[int, ...], verdicts: list[MaskVerdict], expected_px: list[int]) -> dict[int, str]:
    """Return sudden changes of area that the prior does not explain, by frame.

    A mask's area is compared with the median of its neighbours in time, and so is its ratio to the area of the prior
    (`expected_px`, one per frame): a person who turns changes only the first, a mask with a hole or a leak changes
    both.
    """
    found = {}
    area_px = np.array([v.area_px for v in verdicts], float)
    ratio = area_px / np.maximum(expected_px, 1)
    usable = np.array([v.fault is None for v in verdicts])
    reach = NEIGHBOURS * median_step(frames)
    first = np.searchsorted(frames, np.array(frames) - reach)
    end = np.searchsorted(frames, np.array(frames) + reach + 1)
    for i, frame in enumerate(frames):
        others = [j for j in range(first[i], end[i]) if j != i and usable[j]]
        near = sorted(others, key=lambda j: abs(frames[j] - frame))[:NEIGHBOURS]
        if not usable[i] or len(near) < NEIGHBOURS:
            continue
        changes = [max(x[i], 1) / np.median(x[near]).clip(1e-9) for x in (area_px, ratio * 1e3)]
        if all(max(c, 1 / c) > MAX_AREA_RATIO for c in changes):
            found[frame] = f"area jumps from {np.median(area_px[near]):.0f} to {area_px[i]:.0f} px"
    return found

"""Intrinsics of one camera from images of a board, and whether the images suffice."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from hnerf.calibration.boards.fisheye import fit_fisheye
from hnerf.calibration.boards.rig import fixes_pose
from hnerf.capture.lens import Lens, known_size
from hnerf.evenly_spaced import evenly_spaced

MAX_PICTURES = 40  # evenly spaced
MIN_PICTURES = 10
MIN_MOVED = 0.02  # of an image's longer side, by the median corner: pictures of a board held still count as one
MIN_TILTED = 5  # images; boards parallel to the image plane say nothing about the focal length or its error
TILT_DEG = 15.0
K3_SIGMAS = 5.0  # standard deviations that k3 must exceed: few lenses need it, and it bends images beyond the corners
MAX_RMS = 0.0005  # of an image's longer side: three times what webcams leave
# Times that corners must be closer to a fisheye. With k1 k2 p1 p2 k3, equidistant fisheyes of 100 degrees across leave
# twice as much, and rays 5 px off; those of 120 leave MAX_RMS, and rays 2 degrees off. Of webcams, this is 1.00.
FISHEYE_GAIN = 1.5
MAX_FOCAL_STD = 0.01  # relative standard deviation up to which a focal length is trusted


@dataclass(frozen=True)
class LensEstimate:
    """Estimated lens. pictures: number of images used, between which the board moved; lens: None if they are too few;
    tilted: how many of them show the board TILT_DEG or more out of the image plane; focal_std: the focal length's
    relative standard deviation; rms_px: how far corners are from where the lens images them."""

    pictures: int
    lens: Lens | None = None
    tilted: int = 0
    focal_std: float = np.inf
    rms_px: float = np.inf

    @property
    def reliable_lens(self) -> Lens | None:
        """Return the lens if the images determine it, else None."""
        return self.lens if self.focal_std <= MAX_FOCAL_STD and self.tilted >= MIN_TILTED else None

    @property
    def describes_corners(self) -> bool:
        """Return whether a lens was found that images the corners where they are."""
        return self.lens is not None and self.rms_px <= MAX_RMS * max(known_size(self.lens))

    @property
    def certainty(self) -> str:
        """Return how well the lens is known, in words."""
        if self.lens is None:
            return f"pictures between which the board moved: {self.pictures} where {MIN_PICTURES} are needed"
        known = f"focal length known to {100 * self.focal_std:.1f} %, corners off by {self.rms_px:.2f} px"
        kind = "a fisheye, " if self.lens.fisheye else ""
        return f"{self.pictures} pictures of the board, {self.tilted} of them tilted, {kind}{known}"


def estimate_lens(name: str, corners_m: np.ndarray, corners_px: np.ndarray, size_px: tuple[int, int]) -> LensEstimate:
    """Estimate intrinsics and distortion k1 k2 p1 p2, and k3 if the images prove it, as those of wide lenses do, from
    corners_px (F, N, 2) as recorded, NaN where not seen (Zhang 2000). If a fisheye describes the corners, and clearly
    better, the lens is a fisheye.

    The standard deviation is that of the least squares (cv2.calibrateCameraExtended), which takes pictures for
    independent: of those between which the board did not move, only the first is used.
    """
    found = np.flatnonzero(fixes_pose(corners_m, np.isfinite(corners_px[..., 0])))
    chosen = evenly_spaced(found[_moved(corners_px[found], MIN_MOVED * max(size_px))].tolist(), MAX_PICTURES)
    if len(chosen) < MIN_PICTURES:
        return LensEstimate(len(chosen))
    seen = [np.isfinite(corners_px[f, :, 0]) for f in chosen]
    points_m = [corners_m[s].astype(np.float32) for s in seen]
    points_px = [corners_px[f, s].astype(np.float32) for f, s in zip(chosen, seen, strict=True)]
    for flags in (0, cv2.CALIB_FIX_K3):
        rms_px, K, distortion, turns, _, deviation, _, _ = cv2.calibrateCameraExtended(
            points_m, points_px, size_px, np.eye(3), np.zeros(5), flags=flags
        )
        needs_k3 = abs(distortion.ravel()[4]) > K3_SIGMAS * deviation[8, 0]
        if needs_k3:
            break
    lens = Lens(name, K, distortion.ravel()[: 5 if needs_k3 else 4], np.eye(3), np.zeros(3), size_px)
    focal_std = float(max(deviation[0, 0] / K[0, 0], deviation[1, 0] / K[1, 1]))
    pinhole = LensEstimate(len(chosen), lens, _tilted(turns), focal_std, rms_px)
    shown = [corners_m[s] for s in seen], [corners_px[f, s] for f, s in zip(chosen, seen, strict=True)]
    lens, turns, focal_std, rms_px = fit_fisheye(name, *shown, size_px)
    fisheye = LensEstimate(len(chosen), lens, _tilted(turns), focal_std, rms_px)
    closer = FISHEYE_GAIN * fisheye.rms_px < pinhole.rms_px
    return fisheye if closer and fisheye.describes_corners else pinhole


def _tilted(turns: Sequence[np.ndarray]) -> int:
    """Return how many boards, turned by these rotation vectors, are TILT_DEG or more out of the image plane."""
    return sum(abs(cv2.Rodrigues(turn)[0][2, 2]) < np.cos(np.deg2rad(TILT_DEG)) for turn in turns)


def _moved(corners_px: np.ndarray, least_px: float) -> list[int]:
    """Return the pictures, of corners (F, N, 2), in which the median of the corners seen in both is at least so far
    from its place in each picture returned before."""
    kept = list[int]()
    for i, corners in enumerate(corners_px):
        distances_px = np.linalg.norm(corners_px[kept] - corners, axis=-1)
        common = np.isfinite(distances_px)
        if all(np.median(d[seen]) >= least_px for d, seen in zip(distances_px, common, strict=True) if seen.any()):
            kept.append(i)
    return kept

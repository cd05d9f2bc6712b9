"""Image matches: SIFT correspondences between cameras, on the background and on the person."""

import dataclasses
import logging
from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np

from hnerf.capture.capture import Capture
from hnerf.geometry.camera import Camera
from hnerf.pycolmap_import import pycolmap

INLIER_PX = 3.0  # of the fundamental matrix that verifies matches
MIN_MATCHES = 15  # and the share MIN_INLIERS: a fundamental matrix fits some wrong matches by chance
MIN_INLIERS = 0.3

log = logging.getLogger("hnerf.calibration")
pycolmap.logging.minloglevel = 1  # warnings only: SIFT otherwise logs which device it uses


@dataclasses.dataclass(frozen=True)
class Matches:
    """Verified matches by pair of overlapping cameras: (n, 2, 2) pixels, in the first and in the second camera, in the
    images of one frame."""

    by_pair: dict[tuple[str, str], np.ndarray]
    frame: int

    @staticmethod
    def of(capture: Capture) -> "Matches":
        """Match the training cameras' images of one frame. Cameras too far apart to match have no pair, which is not an
        error.

        A pair is verified by a fundamental matrix of its own, not by the calibration, which is being checked.
        """
        names, frame = capture.train_cameras, capture.frames[len(capture.frames) // 2]
        log.info("SIFT in %d cameras", len(names))
        extractor = pycolmap.FeatureExtractor.create(pycolmap.FeatureExtractionOptions(use_gpu=False))
        matcher = pycolmap.FeatureMatcher.create(pycolmap.FeatureMatchingOptions(use_gpu=False))
        grey = {name: cv2.cvtColor(capture.image(name, frame), cv2.COLOR_RGB2GRAY) for name in names}
        features = {name: extractor.extract_from_uint8_array(image) for name, image in grey.items()}
        verified = {
            (a, b): _verified_matches(_match_features(matcher, features[a], features[b]))
            for a, b in combinations(names, 2)
        }
        return Matches({pair: matched for pair, matched in verified.items() if len(matched)}, frame)

    def residuals_px(self, cameras: Sequence[Camera]) -> dict[tuple[str, str], np.ndarray]:
        """Return the Sampson distances of each pair's matches under these cameras, (n,) pixels."""
        named = {camera.name: camera for camera in cameras}
        return {
            (a, b): sampson_px(fundamental(named[a], named[b]), matched)
            for (a, b), matched in self.by_pair.items()
            if a in named and b in named
        }


def fundamental(a: Camera, b: Camera) -> np.ndarray:
    """Return the fundamental matrix F (3, 3) with x_b^T F x_a = 0 (Hartley and Zisserman 2004, eq. 9.1)."""
    R = b.R @ a.R.T
    x, y, z = b.t_m - R @ a.t_m
    return np.linalg.inv(b.K).T @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R @ np.linalg.inv(a.K)


def sampson_px(F: np.ndarray, matched: np.ndarray) -> np.ndarray:
    """Return the first-order distance of matches (n, 2, 2) to the epipolar constraint, (n,) (ibid., root of eq.
    11.9)."""
    x = np.concatenate([matched, np.ones_like(matched[..., :1])], -1)
    in_b, in_a = x[:, 0] @ F.T, x[:, 1] @ F
    gradient = np.sqrt((in_b[:, :2] ** 2).sum(1) + (in_a[:, :2] ** 2).sum(1))
    return np.abs((x[:, 1] * in_b).sum(1)) / gradient


def _match_features(
    matcher: pycolmap.FeatureMatcher,
    a: tuple[pycolmap.FeatureKeypoints, pycolmap.FeatureDescriptors],
    b: tuple[pycolmap.FeatureKeypoints, pycolmap.FeatureDescriptors],
) -> np.ndarray:
    """Return the matches of two images' features, (n, 2, 2) pixels."""
    matched = [(a[0][int(i)], b[0][int(j)]) for i, j in matcher.match(*a, *b)]
    return np.reshape([[(one.x, one.y) for one in pair] for pair in matched], (-1, 2, 2)) - 0.5  # centres at integers


def _verified_matches(matched: np.ndarray) -> np.ndarray:
    """Return those matches of (n, 2, 2) that a fundamental matrix explains; none if it explains too few."""
    if len(matched) < MIN_MATCHES:
        return matched[:0]
    ransac = pycolmap.RANSACOptions(max_error=INLIER_PX, random_seed=0)
    found = pycolmap.estimate_fundamental_matrix(matched[:, 0], matched[:, 1], ransac)
    inliers = found["inlier_mask"] if found else np.zeros(len(matched), bool)
    return matched[inliers] if inliers.sum() >= MIN_MATCHES and inliers.mean() >= MIN_INLIERS else matched[:0]

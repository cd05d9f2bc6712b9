"""Linear blend skinning of an exported rig, and the refitting of its weights to few joints per point."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

WEIGHT_COST_M = 1e-3  # to change a weight by 1 costs as much as to move a point this far; decides where poses do not


@dataclass(frozen=True)
class Skin:
    """Skin weights. joints (V, K); weights (V, K) sum to 1, largest first; unused entries are joint 0 with weight 0."""

    joints: np.ndarray
    weights: np.ndarray

    def moved_to(self, taken_by: np.ndarray) -> "Skin":
        """Return the skin with every joint's weights given to the joint taken_by (J,) of another skeleton."""
        joints = taken_by[self.joints]
        same = (joints[:, :, None] == joints[:, None, :]) & (self.weights[:, None, :] > 0)
        first = same.argmax(2) == np.arange(joints.shape[1])
        summed = np.where(first & (self.weights > 0), (same * self.weights[:, None, :]).sum(2), 0)
        return largest_first(joints, summed)

    @property
    def influences(self) -> int:
        """Return the greatest number of joints that a point follows."""
        return int((self.weights > 0).sum(1).max())


def skinned(transforms: np.ndarray, skin: Skin, points_m: np.ndarray) -> np.ndarray:
    """Return points at rest (V, 3) moved by joints' transforms from rest to stage, (J, 4, 4)."""
    vertices, influences = skin.joints.shape
    ends = np.arange(0, skin.joints.size + 1, influences)
    # As a sparse matrix, a quarter of the time that copying a transform for each influence takes.
    shares = csr_array((skin.weights.ravel(), skin.joints.ravel(), ends), (vertices, len(transforms)))
    blended = (shares @ transforms[:, :3].reshape(-1, 12)).reshape(-1, 3, 4)
    return np.einsum("vab,vb->va", blended[..., :3], points_m) + blended[..., 3]


def with_few_influences(skin: Skin, poses: Iterator[tuple[np.ndarray, np.ndarray]], influences: int) -> Skin:
    """Return the skin with at most `influences` joints per point whose weights move the points least.

    poses: transforms from rest to stage (J, 4, 4) and points at rest (V, 3), frame by frame. The mean squared movement
    is a quadratic form in the change of weights. It is minimised, with weights that sum to 1, for every subset of a
    point's joints; the best solution without a negative weight is the global minimum.
    """
    many = np.nonzero((skin.weights > 0).sum(1) > influences)[0]
    if not len(many):
        return largest_first(skin.joints, skin.weights, influences)
    joints, before = skin.joints[many], skin.weights[many].astype(np.float64)
    form = np.zeros((len(many), before.shape[1], before.shape[1]))
    frames = 0
    for transforms, points_m in poses:
        each_m = np.einsum("vkab,vb->vka", transforms[joints, :3, :3], points_m[many]) + transforms[joints, :3, 3]
        off_m = each_m - (before[..., None] * each_m).sum(1, keepdims=True)
        form += off_m @ off_m.swapaxes(1, 2)
        frames += 1
    form = form / max(frames, 1) + WEIGHT_COST_M**2 * np.eye(before.shape[1])
    weights = skin.weights.copy()
    weights[many] = _best_subsets(form, before, influences)
    return largest_first(skin.joints, weights, influences)


def _best_subsets(form: np.ndarray, before: np.ndarray, influences: int) -> np.ndarray:
    """Return for each point the weights w (V, K) >= 0 of sum 1, at most `influences` of them positive, that minimise
    (w - before)^T form (w - before); form (V, K, K)."""
    pull = np.einsum("vij,vj->vi", form, before)
    best, least = np.zeros_like(before), np.full(len(before), np.inf)
    for count in range(1, influences + 1):
        for subset in itertools.combinations(range(before.shape[1]), count):
            at = list(subset)
            system = np.zeros((len(before), count + 1, count + 1))
            system[:, :count, :count], system[:, count, :count], system[:, :count, count] = form[:, at][..., at], 1, 1
            right = np.concatenate([pull[:, at], np.ones((len(before), 1))], 1)
            found = np.linalg.solve(system, right[..., None])[:, :count, 0]
            tried = np.zeros_like(before)
            tried[:, at] = found
            off = tried - before
            cost = np.einsum("vi,vij,vj->v", off, form, off)
            better = (found >= 0).all(1) & (before[:, at] > 0).all(1) & (cost < least)
            best[better], least[better] = tried[better], cost[better]
    return best


def largest_first(joints: np.ndarray, weights: np.ndarray, influences: int | None = None) -> Skin:
    """Return the skin of joints and weights (V, K) with the `influences` largest weights of each point, or all."""
    order = np.argsort(-weights, axis=1, kind="stable")[:, :influences]
    weights = np.take_along_axis(weights, order, 1)
    joints = np.where(weights > 0, np.take_along_axis(joints, order, 1), 0)
    return Skin(joints, weights / weights.sum(1, keepdims=True))

"""Gauss-Newton steps for a sequence: frames coupled to their neighbours in time, and all of them to shared unknowns.

The normal matrix is block-banded (each frame, its neighbour, and the one after) with a dense border for the shape, so a
step costs time linear in the number of frames (Triggs et al. 1999, section 6: Schur complement of an arrow matrix).
Robust terms are re-weighted at every step.
"""

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from torch import Tensor


class NormalEquations:
    """Sums of J^T W J and J^T W r. frame[k] (n - k, U, U) couples frame i with frame i + k."""

    def __init__(self, frames: int, unknowns: int, shared: int) -> None:
        self.frame = [np.zeros((max(frames - k, 0), unknowns, unknowns)) for k in range(3)]
        self.border = np.zeros((frames, unknowns, shared))
        self.shared = np.zeros((shared, shared))
        self.frame_gradient = np.zeros((frames, unknowns))
        self.shared_gradient = np.zeros(shared)
        self.coupling_diagonal = np.zeros((frames, unknowns))  # added to the diagonal by smoothness in time

    def add_points(self, matrix: Tensor, pull: Tensor, by_frame: Tensor, by_shared: Tensor) -> None:
        """Add a term of points in space: its matrices (n, K, 3, 3) and gradients (n, K, 3) with respect to the points,
        and the points' derivatives with respect to the frame's unknowns (n, K, 3, U) and the first shared ones (n, K,
        3, S)."""
        own = by_shared.shape[-1]
        weighted = (matrix @ by_frame).flatten(1, 2)
        frame, shared, gradient = by_frame.flatten(1, 2), by_shared.flatten(1, 2), pull.flatten(1)[..., None]
        self.frame[0] += (frame.mT @ weighted).numpy()
        self.border[..., :own] += (weighted.mT @ shared).numpy()
        self.shared[:own, :own] += ((matrix @ by_shared).flatten(0, 2).mT @ by_shared.flatten(0, 2)).numpy()
        self.frame_gradient += (frame.mT @ gradient)[..., 0].numpy()
        self.shared_gradient[:own] += (shared.mT @ gradient)[..., 0].sum(0).numpy()

    def step(self, damping: float, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Solve for the step of the frames (n, U) and of the shared unknowns (S,), which stay between low and high
        (S,).

        `damping` times the diagonal, without the terms that couple frames, is added (Marquardt 1963): damping the
        coupling too would hold back movement that all frames share. Shared unknowns that would leave their bounds are
        held at them, and the rest solved again.
        """
        frames, unknowns = self.frame_gradient.shape
        factor = (cholesky_banded(self._banded(damping), lower=True, check_finite=False), True)
        border = self.border.reshape(frames * unknowns, len(self.shared))
        solved = cho_solve_banded(factor, np.column_stack([self.frame_gradient.ravel(), border]), check_finite=False)
        schur = self.shared + damping * np.diag(np.diag(self.shared)) - border.T @ solved[:, 1:]
        gradient = self.shared_gradient - border.T @ solved[:, 0]
        shared = _bounded_solve(schur, -gradient, low, high)
        return (-solved[:, 0] - solved[:, 1:] @ shared).reshape(frames, unknowns), shared

    def _banded(self, damping: float) -> np.ndarray:
        """Return the lower band storage of the frames' block matrix for scipy.linalg: band[i - j, j] = H[i, j]."""
        frames, unknowns = self.frame_gradient.shape
        band = np.zeros((3 * unknowns, frames * unknowns))
        column = np.arange(unknowns)
        for k, blocks in enumerate(self.frame):
            for i in range(unknowns):  # row of the block below the diagonal: H[t + k, t] = frame[k][t]^T
                offset = k * unknowns + i - column
                keep = offset >= 0
                starts = np.arange(len(blocks))[:, None] * unknowns + column[keep]
                band[offset[keep], starts] = blocks[:, column[keep], i]
        band[0] += damping * (band[0] - self.coupling_diagonal.ravel())
        return band


def _bounded_solve(matrix: np.ndarray, target: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Solve matrix x = target, holding at its bound whatever would cross it."""
    held = np.zeros(len(target), bool)
    value = np.zeros(len(target))
    while not held.all():
        free = ~held
        value[free] = np.linalg.solve(
            matrix[np.ix_(free, free)], target[free] - matrix[np.ix_(free, held)] @ value[held]
        )
        crossed = free & ((value < low) | (value > high))
        if not crossed.any():
            break
        value[crossed] = value[crossed].clip(low[crossed], high[crossed])
        held |= crossed
    return value


def geman_mcclure(squared: Tensor, sigma: float | Tensor, outlier: float | Tensor) -> tuple[Tensor, Tensor]:
    """Return Geman-McClure (1987) weights of re-weighted least squares for squared residuals, and the costs, both of
    the residuals' shape.

    A residual well below `outlier` costs half its square over sigma^2, one far beyond nearly outlier^2 / (2 sigma^2).
    """
    falloff = 1 + squared / outlier**2
    return (sigma * falloff) ** -2, 0.5 * squared / sigma**2 / falloff

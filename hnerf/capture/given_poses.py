"""Poses of a body model that come with a recording, as in ZJU-MoCap and PeopleSnapshot."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hnerf.errors import InputError

JOINTS, BETAS = 24, 10  # of SMPL
MAX_TURN_RAD, MAX_MOVE_M, MAX_BETA = 1e3, 1e6, 1e2  # beyond these, the fit has not converged


def check_smpl(path: Path, theta: np.ndarray, moves_m: np.ndarray, betas: np.ndarray) -> None:
    """Raise InputError naming the file if SMPL parameters are not finite, or larger than any body's."""
    parts = (("turns", theta, MAX_TURN_RAD), ("translations", moves_m, MAX_MOVE_M), ("shape values", betas, MAX_BETA))
    for what, values, limit in parts:
        if not (np.abs(values) <= limit).all():  # also true for NaN
            raise InputError(f"{path}: {what} of a pose are NaN or beyond {limit:g}; fit it again, or remove it")


@dataclass(frozen=True)
class GivenPoses:
    """SMPL parameters, a row for each of a capture's frames, NaN where a frame has none: a vertex in the world is root
    @ SMPL(theta, betas).

    theta (n, 24, 3) axis-angle in SMPL's axes, the pelvis's rotation first; root (n, 4, 4) metres, applied after the
    model's rotation about its pelvis; betas (10,).
    """

    theta: np.ndarray
    root: np.ndarray
    betas: np.ndarray

    @staticmethod
    def unknown(frames: int) -> "GivenPoses":
        """Return rows of NaN to fill, and the mean shape."""
        return GivenPoses(np.full((frames, JOINTS, 3), np.nan), np.full((frames, 4, 4), np.nan), np.zeros(BETAS))

    @property
    def known(self) -> np.ndarray:
        """Return which frames have a pose, (n,) bool."""
        return np.isfinite(self.theta).all((1, 2)) & np.isfinite(self.root).all((1, 2))

    def save(self, path: Path) -> None:
        """Write an .npz without pickles."""
        np.savez(path, **dataclasses.asdict(self), model=np.array("smpl"))

    @staticmethod
    def load(path: Path) -> "GivenPoses":
        """Read what `save` wrote."""
        with np.load(path, allow_pickle=False) as stored:
            return GivenPoses(stored["theta"], stored["root"], stored["betas"])

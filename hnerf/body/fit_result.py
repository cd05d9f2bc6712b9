"""The fitted body of a capture: one shape, one pose per frame."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hnerf.body.rig import Rig, joint_transforms, pose_vertices

POSED_AT_ONCE = 256  # frames; each takes a megabyte beside its vertices


@dataclass(frozen=True)
class BodyFit:
    """A fitted body: rig, linearised at the fitted shape (its `beta`); frames (n,); theta (n, J, 3) radians, zero at
    the root joint and at locked joints other than fingers; root (n, 4, 4) world from body, metres."""

    rig: Rig
    frames: tuple[int, ...]
    theta: Tensor
    root: Tensor

    def index(self, frame: int) -> int:
        """Return the row of a capture's frame."""
        return self.frames.index(frame)

    def pose(self, frame: int) -> tuple[Tensor, Tensor]:
        """Return theta (J, 3) and root (4, 4) in a capture's frame."""
        row = self.index(frame)
        return self.theta[row], self.root[row]

    def to(self, device: torch.device | str) -> "BodyFit":
        """Return the same fit on another device."""
        return BodyFit(self.rig.to(device), self.frames, self.theta.to(device), self.root.to(device))

    def vertices_m(self) -> Tensor:
        """Return the posed vertices in the world, (n, V, 3)."""
        parts = zip(self.theta.split(POSED_AT_ONCE), self.root.split(POSED_AT_ONCE), strict=True)
        return torch.cat([pose_vertices(self.rig, theta, root) for theta, root in parts])

    def save(self, folder: Path) -> None:
        """Write `body.npz` (its keys: docs/design.md) and `rig.npz`."""
        joints = joint_transforms(self.rig, self.theta, self.root)[..., :3, 3]
        np.savez(
            folder / "body.npz",
            theta=self.theta.numpy(),
            T=self.root.numpy(),
            beta=self.rig.beta.numpy(),
            frames=np.array(self.frames),
            vertices=self.vertices_m().numpy().astype(np.float32),
            faces=self.rig.faces.numpy(),
            joints=joints.numpy(),
            joint_names=np.array(self.rig.joint_names),
        )
        self.rig.save(folder / "rig.npz")

    @staticmethod
    def load(folder: Path) -> "BodyFit":
        """Read what `save` wrote. Raises ValueError if its arrays do not fit each other."""
        with np.load(folder / "body.npz", allow_pickle=False) as stored:
            frames = tuple(int(f) for f in stored["frames"])
            theta, root = torch.from_numpy(stored["theta"]), torch.from_numpy(stored["T"])
        rig, count = Rig.load(folder / "rig.npz"), len(frames)
        if theta.shape != (count, len(rig.joints_m), 3) or root.shape != (count, 4, 4):
            raise ValueError(f"theta {tuple(theta.shape)}, T {tuple(root.shape)} are not {count} poses of its rig")
        return BodyFit(rig, frames, theta, root)

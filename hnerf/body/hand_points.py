"""The 21 points of a hand on the body model, and what they tell about the body: how forearms and wrists turn."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Articulation, Points, PosedJoints
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.reprojection import Views, project, reprojection_term
from hnerf.body.rig import Rig
from hnerf.capture.capture import Capture

SIDES = ("L", "R")
FINGERS, SEGMENTS = range(1, 6), range(1, 4)  # the thumb is the first; its three segments, from the palm
PALM = [0, 1, 5, 9, 13, 17]  # points that the palm carries: wrist and knuckles
PALM_ROWS = [*PALM, *(21 + k for k in PALM)]  # of both hands
# For a point seen with full confidence: the network is 2.5 px off, in either direction, if a hand is 30 px long.
POINT_STD_M, OUTLIER_M = 0.012, 0.06
PALM_STD_M = POINT_STD_M * len(PALM) ** 0.5  # the points of a palm are off together, so they count as one
SEEN = 0.5  # confidence of a hand's surest point above which a view shows the hand
EPSILON = 1e-9


def has_fingers(rig: Rig) -> bool:
    """Return whether the rig has finger joints, under anny's names."""
    return all(name in rig.joint_names for name in finger_joints())


def finger_joints() -> list[str]:
    """Return the names of the 30 finger joints: left hand, then right, each from the thumb on."""
    return [f"finger{finger}-{segment}.{side}" for side in SIDES for finger in FINGERS for segment in SEGMENTS]


def hand_points(articulation: Articulation) -> Points:
    """Return the 42 points of the left hand, then the right: the wrist, then each finger's three joints and its tip,
    from the thumb on.

    A tip is the vertex of the last segment that is farthest from its joint.
    """
    rig = articulation.rig
    joints, rest, basis = [], [], []
    for side in SIDES:
        wrist = rig.joint_names.index(f"wrist.{side}")
        joints.append(wrist)
        rest.append(rig.joints_m[wrist])
        basis.append(rig.joint_basis[:, wrist])
        for finger in FINGERS:
            chain = [rig.joint_names.index(f"finger{finger}-{segment}.{side}") for segment in SEGMENTS]
            own = (rig.dense_weights[:, chain[-1]] > 0.5).nonzero()[:, 0]
            tip = own[(rig.vertices_m[own] - rig.joints_m[chain[-1]]).norm(dim=-1).argmax()]
            joints += [*chain, chain[-1]]
            rest += [*rig.joints_m[chain], rig.vertices_m[tip]]
            basis += [*rig.joint_basis[:, chain].transpose(0, 1), rig.shape_basis[:, tip]]
    weights = torch.nn.functional.one_hot(articulation.carrier[joints], len(articulation.joints)).to(rest[0].dtype)
    rest_m, basis_m = torch.stack(rest), torch.stack(basis).transpose(1, 2)  # (42, 3), (42, 3, B)
    return Points(weights, weights[..., None] * rest_m[:, None], weights[..., None, None] * basis_m[:, None])


def observe_hands(capture: Capture) -> Views | None:
    """Return the hand points (C, n, 42) of the training cameras, without hands that fewer than two of them see; None if
    hands were not looked for. None also with a single camera: its hand points pull the body to another depth (limb
    joints of valid-walk are 62 mm off, 59 without)."""
    found = [capture.hands(name) for name in capture.train_cameras]
    if len(found) < 2 or not all(hands is not None for hands in found):
        return None
    hands = torch.from_numpy(np.stack([h for h in found if h is not None]).astype(np.float64))  # (C, n, 2, 21, 3)
    cameras = tuple(capture.cameras[name] for name in capture.train_cameras)
    # A single view hardly distinguishes a palm that leans towards the camera from one that leans away.
    seen_twice = (hands[..., 2].amax(-1) > SEEN).sum(0) > 1
    confidence = hands[..., 2] * seen_twice[..., None]
    return Views(cameras, hands[..., :2].flatten(2, 3), confidence.flatten(2, 3))


@dataclass(frozen=True)
class PalmTerm:
    """Reprojection of wrists and knuckles, which turn with the wrist. views: of all hand points."""

    views: Views

    def add(
        self, equations: NormalEquations, articulation: Articulation, joints: PosedJoints, scale_m: Tensor
    ) -> float:
        """Add the term to the normal equations and return its cost. scale_m (C, n): metres a pixel spans."""
        points = hand_points(articulation)
        palm = Points(points.weights[PALM_ROWS], points.rest_m[PALM_ROWS], points.basis_m[PALM_ROWS])
        x, by_frame, by_shape = articulation.jacobian(palm, joints)
        matrix, pull, cost = reprojection_term(self.views.select(PALM_ROWS), scale_m, x, PALM_STD_M, OUTLIER_M)
        equations.add_points(matrix, pull, by_frame, by_shape)
        return cost


def moved_onto_palm(views: Views, x: Tensor) -> Views:
    """Return the views of hand points, shifted in each view so that the mean of each palm coincides with that of x (n,
    42, 3)."""
    pixels = []
    for camera, seen, confidence in zip(views.cameras, views.pixels, views.confidence, strict=True):
        off_px = (project(camera, x)[0] - seen)[:, PALM_ROWS].unflatten(1, (2, -1))
        weight = confidence[:, PALM_ROWS].square().unflatten(1, (2, -1, 1))
        mean_px = (weight * off_px).sum(2) / weight.sum(2).clamp(min=EPSILON)
        pixels.append(seen + mean_px.repeat_interleave(21, 1))
    return replace(views, pixels=torch.stack(pixels))

"""The 21 points of a hand on the body model, and what they say of the body: how forearms and wrists turn."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from hnerf.body.articulation import Articulation, Points, PosedJoints
from hnerf.body.normal_equations import NormalEquations
from hnerf.body.reprojection import Views, project
from hnerf.body.rig import Rig
from hnerf.body.robust import geman_mcclure
from hnerf.capture.capture import Capture

SIDES = ("L", "R")
FINGERS, SEGMENTS = range(1, 6), range(1, 4)  # the thumb is the first; its three segments, from the palm
PALM = [0, 1, 5, 9, 13, 17]  # points that the palm carries: wrist and knuckles
PALM_ROWS = [*PALM, *(21 + k for k in PALM)]  # of both hands
# Of a point seen with full confidence: the network is 2.5 px off where a hand is 30 px long, in either direction.
POINT_STD_M, OUTLIER_M = 0.012, 0.06
EPSILON = 1e-9


def has_fingers(rig: Rig) -> bool:
    """Return whether the rig has the joints of fingers, by anny's names."""
    return all(name in rig.joint_names for name in finger_joints())


def finger_joints() -> list[str]:
    """Return the names of the 30 joints of fingers: of the left hand, then of the right, the thumb's first."""
    return [f"finger{finger}-{segment}.{side}" for side in SIDES for finger in FINGERS for segment in SEGMENTS]


def hand_points(articulation: Articulation) -> Points:
    """Return the points of the left hand, then of the right, (42): of each the wrist, then each finger's three joints
    and its tip, from the thumb on.

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
    """Return the hand points (C, n, 42) of the training cameras; None where none were looked for, and with a single
    camera, where they pull the body to another depth (limb joints of valid-walk 62 mm off, 59 without)."""
    found = [capture.hands(name) for name in capture.train_cameras]
    if len(found) < 2 or not all(hands is not None for hands in found):
        return None
    hands = torch.from_numpy(np.stack([h for h in found if h is not None]).astype(np.float64)).flatten(2, 3)
    cameras = tuple(capture.cameras[name] for name in capture.train_cameras)
    return Views(cameras, hands[..., :2], hands[..., 2])


@dataclass(frozen=True)
class PalmTerm:
    """Reprojection of wrists and knuckles relative to each other, which shows how the wrist turns. views: of all hand
    points.

    Where a hand is, keypoints and outlines say: the network places all points of a hand to one side, a different one in
    each view, and six such points would outvote them.
    """

    views: Views

    def add(
        self, equations: NormalEquations, articulation: Articulation, joints: PosedJoints, scale_m: Tensor
    ) -> float:
        """Add the term to the normal equations and return its cost. scale_m (C, n): metres a pixel spans."""
        points, rows = hand_points(articulation), PALM_ROWS
        palm = Points(points.weights[rows], points.rest_m[rows], points.basis_m[rows])
        x, by_frame, by_shape = articulation.jacobian(palm, joints)
        views, cost = self.views.of(rows), 0.0
        for camera, scale, pixels, confidence in zip(
            views.cameras, scale_m, views.pixels, views.confidence, strict=True
        ):
            uv, by_x = project(camera, x)
            trust, by_x = confidence.square(), by_x * scale[:, None, None, None]
            residual = relative_to_palm((uv - pixels) * scale[:, None, None], trust)
            weight, part = geman_mcclure(residual.square().sum(-1), POINT_STD_M, OUTLIER_M)
            weight, cost = trust * weight, cost + float((trust * part).sum())
            matrix = weight[..., None, None] * torch.eye(2, dtype=x.dtype)
            moves = (relative_to_palm(by_x @ by, trust) for by in (by_frame, by_shape))
            equations.add_points(matrix, weight[..., None] * residual, *moves)
        return cost

    def seen(self) -> Tensor:
        """Return how surely either hand is seen in each frame, (n, 2) in [0, 1]: as by the surest camera."""
        return self.views.confidence[..., [0, 21]].amax(0)


def relative_to_palm(values: Tensor, trust: Tensor) -> Tensor:
    """Return values (n, 12, ...) of the palm points of both hands less each hand's mean, weighted by trust (n, 12)."""
    return values - palm_means(values, trust).repeat_interleave(len(PALM), 1)


def moved_onto_palm(views: Views, x: Tensor) -> Views:
    """Return the views of hand points moved in each view so that the means of the palms are where those of x (n, 42, 3)
    are."""
    rows, pixels = PALM_ROWS, []
    for camera, seen, confidence in zip(views.cameras, views.pixels, views.confidence, strict=True):
        off_px = palm_means((project(camera, x)[0] - seen)[:, rows], confidence[:, rows].square())
        pixels.append(seen + off_px.repeat_interleave(21, 1))
    return replace(views, pixels=torch.stack(pixels))


def palm_means(values: Tensor, trust: Tensor) -> Tensor:
    """Return the means (n, 2, ...) of values (n, 12, ...) over each hand's palm points, weighted by trust (n, 12)."""
    hands, weight = values.unflatten(1, (2, -1)), trust.unflatten(1, (2, -1))
    weight = weight / weight.sum(2, keepdim=True).clamp(min=EPSILON)
    return torch.einsum("nhk,nhk...->nh...", weight, hands)

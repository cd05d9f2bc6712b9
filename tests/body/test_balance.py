import math

import numpy as np
import torch

from hnerf.body.articulation import Articulation, Pose
from hnerf.body.balance import BALANCE_M, Balance, centre_of_mass_over_feet
from hnerf.body.normal_equations import NormalEquations
from tests.body.test_articulation import check_gradient, random_pose
from tests.body.test_pose_prior import ARTICULATION, resting
from tests.body.two_bone import two_bone_rig


def test_an_upright_body_has_its_centre_of_mass_above_its_feet() -> None:
    """The neck has a share of .289; a knee has half a thigh and half a shank with foot, .05 + .0305. The most likely
    pose is balanced to within half a standard deviation."""
    shares = centre_of_mass_over_feet()
    assert abs(float(shares.sum())) < 1e-12
    np.testing.assert_allclose(shares[[1, 10]], [0.289, 0.0805])
    x, _, _ = ARTICULATION.jacobian(ARTICULATION.keypoints(), ARTICULATION.pose(resting()))
    assert float(torch.einsum("k,nkc->nc", shares, x)[:, :2].norm()) < BALANCE_M / 2


def test_one_standard_deviation_off_balance_costs_about_a_half() -> None:
    """The trunk is moved forwards so that the centre of mass moves by one standard deviation, 5 cm: 0.5 / (1 + 1/9)
    with the robust cost. Moving up costs nothing; far off balance, the cost approaches 0.5 x 9."""
    x, jacobian = (torch.zeros(1, 25, 3, *more, dtype=torch.float64) for more in ((), (9,)))
    for up, level in ((2, 1), (1, 2)):
        for axis, far, cost in ((0, 0.05, 0.45), (level, 0.05, 0.45), (up, 0.05, 0.0), (0, 5.0, 4.5 / (1 + 9e-4))):
            moved = x.clone()
            moved[0, [1, 8], axis] = far / 0.578
            assert math.isclose(Balance(up).add(NormalEquations(1, 9, 0), moved, jacobian), cost, abs_tol=1e-9)


def test_the_gradient_of_balance_matches_its_cost() -> None:
    rig = two_bone_rig()
    articulation, pose = Articulation(rig), random_pose(rig, 2)

    def add(equations: NormalEquations, at: Pose) -> float:
        x, by_frame, _ = articulation.jacobian(articulation.keypoints(), articulation.pose(at))
        return Balance(up=1).add(equations, 0.3 * x, 0.3 * by_frame)

    check_gradient(pose, add, rtol=1e-6, least=1e-3)

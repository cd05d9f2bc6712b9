"""A trunk (a slab) and an arm (a rod next to it). A rotation about the arm's top end moves it against or into the
trunk. The tests check which points are also described by the limb that is not the closest, by hand and against trying
every triangle of each limb."""

import torch
from torch import Tensor

from hnerf.body.anny import anny_rig
from hnerf.body.canonical import Descriptor, PosedBodies
from hnerf.body.limbs import CLOSE_M
from hnerf.body.rig import Rig
from tests.body.boxes import box_faces, box_rig, box_vertices, hinged
from tests.body.reference import closest_points_reference, on_surface

LEVELS = 40
SHOULDER_M = (1.2, 0.05, 1.0)
REACH_M = 0.3
ONE = torch.zeros(1, dtype=torch.long)


def limbs_rig(gap_m: float = 0.2) -> Rig:
    """Return the trunk, from x = 0 to 1 m, and the arm, 0.1 m wide and `gap_m` next to it, hanging from its joint at
    the top. Both are 0.1 m thick along y and 1 m high."""
    trunk, arm = (box_vertices(1.0, LEVELS) * torch.tensor([x, 0.1, 1.0]) for x in (1.0, 0.1))
    vertices_m = torch.cat([trunk, arm + torch.tensor([1 + gap_m, 0.0, 0.0])])
    faces = torch.cat([box_faces(LEVELS), box_faces(LEVELS) + len(trunk)])
    on_arm = torch.cat([torch.zeros(len(trunk)), torch.ones(len(arm))])
    joints_m = torch.tensor([[0.5, 0.05, 0.0], SHOULDER_M])
    return hinged(vertices_m, faces, joints_m, ("root", "upperarm01.L"), on_arm)


def swung(slope: float) -> PosedBodies:
    """Return the bodies with the arm turned about y, so that it approaches the trunk by `slope` metres per metre below
    the shoulder."""
    rig, theta = limbs_rig(), torch.zeros(1, 2, 3)
    theta[0, 1, 1] = torch.tensor(slope).atan()
    return PosedBodies(rig, theta, torch.eye(4)[None], rig.vertices_m)


def at(*points: tuple[float, float, float]) -> Tensor:
    return torch.tensor(points)


def by_other_limbs(bodies: PosedBodies, points_m: Tensor) -> tuple[Tensor, Descriptor]:
    """Return the indices of points that a limb other than the closest one describes too, and these descriptors."""
    described, more = bodies.describe_by_limbs(points_m, ONE.expand(len(points_m)), REACH_M)
    return more, described.pick(torch.arange(len(points_m), len(described.d)))


def test_no_points_where_no_ray_meets_the_person() -> None:
    more, others = by_other_limbs(swung(0.2), torch.zeros(0, 3))
    assert len(more) == len(others.d) == 0


def test_limbs_start_at_their_first_joints() -> None:
    limbs = limbs_rig().limbs
    assert torch.equal(limbs.vertex_limb, torch.tensor([0, 1]).repeat_interleave(4 * (LEVELS + 1)))
    assert not limbs.on_cut.any()
    facing = limbs.samples[(limbs_rig().vertices_m[limbs.samples, 0] - 1.2).abs() < 1e-6]
    torch.testing.assert_close(limbs.rest_m[limbs.sample_of[facing], 0], torch.full((len(facing),), 0.2))


def test_a_body_without_limbs_is_all_trunk() -> None:
    limbs = box_rig().limbs
    assert not limbs.vertex_limb.any() and limbs.rest_m.isinf().all()
    assert not limbs.close(torch.zeros(2, len(limbs.vertex_limb), 3)).any()


def test_only_limbs_that_moved_closer_than_at_rest_are_close() -> None:
    """At rest the arm is 20 cm away. With a slope of 0.2, it is closer than 6 cm from 70 cm below the shoulder on.
    There, the trunk's vertices that face the arm are close to it, and vice versa. An arm that is 4 cm away at rest does
    not count as close."""
    rig, bodies = limbs_rig(), swung(0.2)
    limbs = rig.limbs
    assert not limbs.close(rig.vertices_m[None]).any()
    close = limbs.close(bodies.vertices_m)[0]
    x, _, z = rig.vertices_m.T
    facing = (x == 1) | ((x - 1.2).abs() < 1e-6)
    lower, upper = facing & (z < 0.25), facing & (z > 0.4)
    own = limbs.vertex_limb
    assert close[lower, 1 - own[lower]].all() and not close[upper].any()
    assert not close[torch.arange(len(own)), own].any() and not close[:, 2:].any()
    rig = limbs_rig(0.04)
    assert not rig.limbs.close(rig.vertices_m[None]).any()
    assert CLOSE_M == 0.06


def test_limbs_are_as_close_wherever_the_person_stands() -> None:
    """A kilometre from the origin, single precision is good for 0.1 mm; no distance is so near the limit of 6 cm."""
    limbs, posed_m = limbs_rig().limbs, swung(0.21).vertices_m
    close = limbs.close(posed_m)
    assert 10 < close.sum() < 200
    for place_m in ((1003.0, -504.0, 2.0), (56.0, 0.0, 34.0)):
        assert torch.equal(limbs.close(posed_m + torch.tensor(place_m)), close)


def test_a_point_between_two_limbs_is_described_by_both() -> None:
    """With a slope of 0.2, the arm's face is 4 cm from the trunk at 0.8 m below the shoulder. A point 1 cm from the
    trunk is 3 cm from the arm, times the cosine of the slope. Farther up, where they are apart, the arm is not
    queried."""
    bodies = swung(0.2)
    found, other = by_other_limbs(bodies, at((1.01, 0.05, 0.2), (1.01, 0.05, 0.9)))
    assert found.tolist() == [0]
    cosine = 1 / 1.04**0.5
    torch.testing.assert_close(other.d, torch.tensor([0.03 * cosine]), atol=1e-4, rtol=0)
    down_m = (0.8**2 + 0.19**2 - (0.03 * cosine) ** 2) ** 0.5  # along the arm, from its joint to the closest point
    torch.testing.assert_close(other.y, at((1.2 - 0.03 * cosine, 0.05, 1 - down_m)), atol=1e-4, rtol=0)
    assert (other.vertex >= 4 * (LEVELS + 1)).all()


def test_distances_to_other_limbs_match_the_reference() -> None:
    """The arm cuts into the trunk. For all points around the two, distance and sign of the other limb are those of that
    limb alone."""
    bodies = swung(0.35)
    rig, vertices_m = bodies.rig, bodies.vertices_m[0]
    points_m = torch.rand(300, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([0.6, 0.3, 1.2])
    points_m += torch.tensor([0.8, -0.1, -0.1])
    found, other = by_other_limbs(bodies, points_m)
    arms = rig.faces.amin(1) >= 4 * (LEVELS + 1)
    expected = []
    for faces in (rig.faces[~arms], rig.faces[arms]):
        of_limb = closest_points_reference(points_m, vertices_m, faces, 9.0)
        expected.append(of_limb.sign * (on_surface(vertices_m, faces, of_limb) - points_m).norm(dim=1))
    of_arm = (other.vertex >= 4 * (LEVELS + 1)).long()
    assert len(found) > 75 and 0 < of_arm.sum() < len(found)
    torch.testing.assert_close(other.d, torch.stack(expected, 1)[found, of_arm], atol=1e-5, rtol=0)


def test_no_point_is_described_by_the_cut_end_of_a_limb() -> None:
    """An arm is pressed into the trunk. The trunk's cut at the shoulder lies inside the body and is no surface."""
    rig = anny_rig()
    theta = torch.zeros(1, len(rig.joints_m), 3)
    theta[0, rig.joint_names.index("upperarm01.L"), 1] = 0.9
    bodies = PosedBodies(rig, theta, torch.eye(4)[None], rig.vertices_m)
    limbs = rig.limbs
    arm = limbs.vertex_limb == 1
    points_m = bodies.vertices_m[0, arm]
    found, other = by_other_limbs(bodies, points_m)
    share_on_cut = (limbs.on_cut[other.corners] * other.barycentric).sum(1)
    assert 50 < len(found) < len(points_m)
    assert (share_on_cut < 0.9999).all()
    assert limbs.on_cut.sum() < 300

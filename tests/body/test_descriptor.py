"""The descriptor (d, s): by hand on a box, the fast form against the reference, gradients against finite
differences."""

import dataclasses

import pytest
import torch
import trimesh
from torch import Tensor

from hnerf.body.anny import anny_rig
from hnerf.body.canonical import PosedBodies, axis_angle_from_rotation, distinct_rows, weighted_sum
from hnerf.body.descriptor import BodyMeshes
from hnerf.body.rig import Rig, pose_vertices, rotation_from_axis_angle
from tests.body.boxes import box_faces, box_rig, box_vertices
from tests.body.reference import closest_points_reference, on_surface


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("moved_m", [0.0, 1.0])
def test_closest_points_of_a_box_by_hand(exact: bool, moved_m: float):
    """The point (2, 0.5, 0.5) is 1 m from the unit box, nearest to (1, 0.5, 0.5). The second point is inside, 0.4 m
    above the bottom. If the box and the points move along x, so do the closest points."""
    away = torch.tensor([moved_m, 0.0, 0.0])
    vertices, faces, points = box_vertices(), box_faces(), torch.tensor([[2.0, 0.5, 0.5], [0.5, 0.5, 0.4]])
    meshes = BodyMeshes(vertices[None], faces)
    if moved_m:
        meshes.refit((vertices + away)[None])
    found = meshes.closest_points(points + away, torch.zeros(2, dtype=torch.int32), 5.0, exact)
    closest = on_surface(vertices + away, faces, found)
    torch.testing.assert_close(closest, torch.tensor([[1.0, 0.5, 0.5], [0.5, 0.5, 0.0]]) + away)
    assert found.sign.tolist() == [1.0, -1.0]


def test_points_out_of_reach_have_face_minus_one():
    found = BodyMeshes(box_vertices()[None], box_faces()).closest_points(
        torch.tensor([[2.0, 0.5, 0.5]]), torch.zeros(1, dtype=torch.int32), 0.9
    )
    assert found.face.tolist() == [-1]


@pytest.mark.parametrize("exact", [False, True])
def test_fast_closest_points_match_the_reference(exact: bool):
    """Points all around a posed body have the same distances and the same signs."""
    rig = box_rig(bend_segments=6)
    theta = torch.zeros(1, 2, 3)
    theta[0, 1] = torch.tensor([0.0, 0.7, 0.0])
    bodies = PosedBodies(rig, theta, torch.eye(4)[None], rig.vertices_m)
    vertices = bodies.vertices_m[0]
    points = (
        vertices.amin(0)
        - 0.2
        + torch.rand(800, 3, generator=torch.Generator().manual_seed(0)) * (vertices.amax(0) - vertices.amin(0) + 0.4)
    )
    fast = BodyMeshes(vertices[None], rig.faces).closest_points(points, torch.zeros(800, dtype=torch.int32), 9.0, exact)
    slow = closest_points_reference(points, vertices, rig.faces, 9.0)

    distances = [(on_surface(vertices, rig.faces, found) - points).norm(dim=1) for found in (fast, slow)]
    torch.testing.assert_close(*distances, atol=1e-6, rtol=0)
    assert torch.equal(fast.sign, slow.sign)


def test_exact_sign_inside_a_body_that_intersects_itself():
    """Two unit boxes overlap from x = 0.6 to 1. At x = 0.55 the nearest surface is the second box's buried wall. The
    point is outside that wall, but inside the first box."""
    vertices = torch.cat([box_vertices(), box_vertices() + torch.tensor([0.6, 0.0, 0.0])])
    faces = torch.cat([box_faces(), box_faces() + 8])
    point, row = torch.tensor([[0.55, 0.5, 0.5]]), torch.zeros(1, dtype=torch.int32)
    meshes = BodyMeshes(vertices[None], faces)
    assert meshes.closest_points(point, row, 5.0, exact_sign=True).sign.tolist() == [-1.0]
    assert closest_points_reference(point, vertices, faces, 5.0).sign.tolist() == [-1.0]


def test_exact_sign_around_and_inside_intersecting_surfaces():
    """Two coarse balls of radius 1 move until their centres are 1.7 apart, so many faces are partly buried."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    sphere, faces = torch.from_numpy(ball.vertices).float(), torch.from_numpy(ball.faces)
    faces = torch.cat([faces, faces + len(sphere)])
    points = torch.rand(1200, 3, generator=torch.Generator().manual_seed(0)) * 3 - torch.tensor([0.5, 1.5, 1.5])
    apart, crossing = (torch.cat([sphere, sphere + torch.tensor([x, 0.1, 0.2])]) for x in (2.5, 1.7))
    meshes, row = BodyMeshes(apart[None], faces), torch.zeros(len(points), dtype=torch.int32)
    for vertices in (apart, crossing):
        meshes.refit(vertices[None])
        wanted = closest_points_reference(points, vertices, faces, 9.0).sign
        assert torch.equal(meshes.closest_points(points, row, 9.0, exact_sign=True).sign, wanted)
    assert not torch.equal(meshes.closest_points(points, row, 9.0).sign, wanted)


def test_canonical_position_undoes_the_pose():
    """For a rigidly turned and moved body, y is the point moved back, and d is unchanged."""
    rig = box_rig()
    root = torch.eye(4)
    root[:3, :3] = rotation_from_axis_angle(torch.tensor([0.3, -0.5, 0.8]))
    root[:3, 3] = torch.tensor([1.0, 2.0, -0.5])
    rest_points = torch.tensor([[0.5, 0.5, 1.2], [1.1, 0.4, 0.3], [0.5, 0.5, 0.1]])
    world = rest_points @ root[:3, :3].T + root[:3, 3]
    described = PosedBodies(rig, torch.zeros(1, 2, 3), root[None], rig.vertices_m).describe(
        world, torch.zeros(3, dtype=torch.int32), 5.0
    )
    torch.testing.assert_close(described.y, rest_points, atol=1e-5, rtol=0)
    torch.testing.assert_close(described.d, torch.tensor([0.2, 0.1, -0.1]), atol=1e-5, rtol=0)


RIGID_POINTS = [[0.5, 0.4, 2.15], [1.15, 0.5, 1.8], [0.4, -0.1, 1.9], [0.45, 0.6, 1.93]]  # near one bone only


@pytest.mark.parametrize("name, index", [("move_m", (0, 2)), ("turn", (0, 1, 0)), ("turn", (0, 0, 1))])
def test_gradients_by_the_pose_match_finite_differences(name: str, index: tuple[int, ...]):
    """Gradients of d and y by the learned correction agree with central differences: move the body (absorb)
    and describe the points again."""
    step = 1e-3  # closest points are found in single precision
    rig = box_rig(bend_segments=6).to(dtype=torch.float64)
    theta, root = torch.zeros(1, 2, 3, dtype=torch.float64), torch.eye(4, dtype=torch.float64)[None]
    points = torch.tensor(RIGID_POINTS, dtype=torch.float64)
    row = torch.zeros(len(points), dtype=torch.int32)

    def described_after(amount: float):
        bodies = PosedBodies(rig, theta, root, rig.vertices_m)
        correction = bodies.correction().double()
        with torch.no_grad():
            getattr(correction, name)[index] = amount
        bodies.absorb(correction)
        return bodies.describe(points, row, 5.0)

    bodies = PosedBodies(rig, theta, root, rig.vertices_m)
    correction = bodies.correction().double()
    now = bodies.describe(points, row, 5.0, correction)
    ahead, behind = described_after(step), described_after(-step)
    for value, after, before in ((now.d, ahead.d, behind.d), (now.y, ahead.y, behind.y)):
        leaf = getattr(correction, name)
        rows = [torch.autograd.grad(one, leaf, retain_graph=True)[0][index] for one in value.flatten()]
        torch.testing.assert_close(torch.stack(rows), ((after - before) / (2 * step)).flatten(), atol=1e-4, rtol=0)


def test_gradients_of_y_are_nearly_right_where_skin_blends_between_joints(rig: Rig) -> None:
    """They take the skin for rigid: right at rest; with all joints turned by about 20 degrees, off by 6 % in the mean,
    by central differences over 0.6 mm at points 3 to 23 mm from the body."""
    random, step = torch.Generator().manual_seed(0), 3e-4
    turned = torch.zeros(1, len(rig.joint_names), 3)
    turned[:, rig.free] = 0.23 * torch.randn(1, int(rig.free.sum()), 3, generator=random)
    errors = []
    for theta in (torch.zeros_like(turned), turned):
        bodies = PosedBodies(rig, theta, torch.eye(4)[None], rig.vertices_m)
        corners_m = bodies.vertices_m[0][rig.faces[torch.randint(len(rig.faces), (4000,), generator=random)]]
        shares = torch.rand(4000, 3, 1, generator=random)
        normal = torch.linalg.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
        away_m = 0.003 + 0.02 * torch.rand(4000, 1, generator=random)
        points_m = (shares * corners_m).sum(1) / shares.sum(1) + away_m * torch.nn.functional.normalize(normal, dim=1)
        row, offsets_m = torch.zeros(4000, dtype=torch.long), step * torch.eye(3)
        here = bodies.describe(points_m.requires_grad_(), row, 5.0)
        found = torch.stack([torch.autograd.grad(y.sum(), points_m, retain_graph=True)[0] for y in here.y.T], 1)
        beside = [[bodies.describe(points_m.detach() + k * by, row, 5.0) for k in (1, -1)] for by in offsets_m]
        wanted = torch.stack([(ahead.y - behind.y) / (2 * step) for ahead, behind in beside], -1)
        inside = (here.barycentric > 0.02).all(1)  # all on the same face
        for one in (one for pair in beside for one in pair):
            inside &= (one.corners == here.corners).all(1)
        assert inside.sum() > 1000
        relative = (found - wanted).flatten(1).norm(dim=1) / wanted.flatten(1).norm(dim=1)
        errors.append(relative[inside].mean().item())
    assert errors[0] < 0.002 and errors[1] < 0.07


def growing_box() -> Rig:
    """Return a box whose shape also moves its upper joint."""
    rig = box_rig(bend_segments=6).to(dtype=torch.float64)
    joint_basis = torch.tensor([[[0.1, 0.0, 0.2], [0.3, -0.2, 0.5]]], dtype=torch.float64)
    return dataclasses.replace(rig, joint_basis=joint_basis)


def reference_distance(points: Tensor, turn: Tensor, move: Tensor, beta: Tensor) -> Tensor:
    """Return d of the column, bent by 0.4 rad and then turned, moved and reshaped, by trying every triangle in double
    precision."""
    rig = growing_box().reshaped(beta)
    theta = torch.zeros(1, 2, 3, dtype=torch.float64)
    theta[0, 1] = axis_angle_from_rotation(rotation_from_axis_angle(turn) @ rotation_from_axis_angle(BENT))
    root = torch.eye(4, dtype=torch.float64)[None].clone()
    root[0, :3, 3] = move
    vertices = pose_vertices(rig, theta, root)[0]
    found = closest_points_reference(points, vertices, rig.faces, 5.0)
    return found.sign * (points - on_surface(vertices, rig.faces, found)).norm(dim=-1)


BENT = torch.tensor([0.4, 0.0, 0.0], dtype=torch.float64)


@pytest.mark.parametrize(
    ("unknown", "axis"), [("beta", 0), *((unknown, axis) for unknown in ("x", "theta", "T") for axis in range(3))]
)
def test_gradients_agree_with_finite_differences_in_double_precision(unknown: str, axis: int):
    """Gradients of the fast form by x, theta, T and beta agree with central differences of the reference."""
    rig = growing_box()
    theta = torch.zeros(1, 2, 3, dtype=torch.float64)
    theta[0, 1] = BENT
    bodies = PosedBodies(rig, theta, torch.eye(4, dtype=torch.float64)[None], rig.vertices_m)
    pivot = rig.joints_m[1]
    points = (torch.tensor(RIGID_POINTS, dtype=torch.float64) - pivot) @ rotation_from_axis_angle(BENT).T + pivot
    points.requires_grad_()
    correction = bodies.correction().double()
    d = bodies.describe(points, torch.zeros(len(points), dtype=torch.int32), 5.0, correction).d
    leaf, index = {
        "x": (points, (slice(None), axis)),
        "theta": (correction.turn, (0, 0, axis)),
        "T": (correction.move_m, (0, axis)),
        "beta": (correction.shape, (0,)),
    }[unknown]
    rows = [torch.autograd.grad(value, leaf, retain_graph=True)[0] for value in d]
    found = torch.stack([row[k, axis] if unknown == "x" else row[index] for k, row in enumerate(rows)])

    def moved(step: float) -> Tensor:
        change = torch.zeros(3, dtype=torch.float64)
        change[axis] = step
        nothing = torch.zeros(3, dtype=torch.float64)
        turn, move = (change if unknown == name else nothing for name in ("theta", "T"))
        beta = torch.full((1,), step if unknown == "beta" else 0.0, dtype=torch.float64)
        return reference_distance(points.detach() + (change if unknown == "x" else 0.0), turn, move, beta)

    step = 1e-5
    torch.testing.assert_close(found, (moved(step) - moved(-step)) / (2 * step), atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("point", "follows"),
    [
        ([0.4, 0.3, 1.2], [1.0, 1.0, 0.0]),  # above the top face
        ([1.1, 0.3, 1.2], [0.0, 1.0, 0.0]),  # off its edge along y
        ([1.1, -0.2, 1.2], [0.0, 0.0, 0.0]),  # off its corner
    ],
)
def test_the_closest_point_slides_along_faces_and_edges(point: list[float], follows: list[float]):
    """ds_k / dx_k of a unit box has the values worked out by hand, and agrees with finite differences."""
    rig = box_rig()
    bodies = PosedBodies(rig, torch.zeros(1, 2, 3), torch.eye(4)[None], rig.vertices_m)
    x, step, only = torch.tensor([point], requires_grad=True), 1e-2, torch.zeros(1, dtype=torch.int32)
    s = bodies.describe(x, only, 5.0).s[0]
    found = [torch.autograd.grad(s[k], x, retain_graph=True)[0][0, k].item() for k in range(3)]
    assert found == pytest.approx(follows, abs=1e-5)
    for k in range(3):
        ahead, behind = (bodies.describe(x + sign * step * torch.eye(3)[k], only, 5.0).s[0, k] for sign in (1, -1))
        assert (ahead - behind).item() / (2 * step) == pytest.approx(follows[k], abs=1e-4)


def test_frames_of_one_posture_share_their_mean_rotation():
    """Two frames turned by +0.02 and -0.02 rad have a mean of 0. Turned by +0.02 and 0.06 rad, both get the mean of
    0.04."""
    rig = box_rig()
    bodies = PosedBodies(rig, torch.zeros(2, 2, 3), torch.eye(4).repeat(2, 1, 1), rig.vertices_m)
    correction = bodies.correction()
    for second, mean in ((-0.02, 0.0), (0.06, 0.04)):
        with torch.no_grad():
            correction.turn[0, 0, 0], correction.turn[1, 0, 0] = 0.02, second
        bodies.absorb(correction, same_posture=torch.arange(2))
        torch.testing.assert_close(bodies.theta[:, 1, 0], torch.full((2,), mean))
        torch.testing.assert_close(correction.totals()[0][:, 0, 0], torch.full((2,), mean))


def test_absorbing_a_correction_keeps_its_total():
    rig = box_rig()
    bodies = PosedBodies(rig, torch.zeros(1, 2, 3), torch.eye(4)[None], rig.vertices_m)
    correction = bodies.correction()
    with torch.no_grad():
        correction.move_m[0, 0] = 0.25
    bodies.absorb(correction)
    assert correction.move_m.abs().max().item() == 0
    assert correction.totals()[1].tolist() == [[0.25, 0.0, 0.0]]
    torch.testing.assert_close(bodies.vertices_m[0], rig.vertices_m + torch.tensor([0.25, 0.0, 0.0]))


def test_axis_angle_from_rotation_inverts_the_exponential():
    angles = torch.tensor([[0.0, 0.0, 0.0], [1e-5, 0.0, 0.0], [0.5, -1.0, 0.3], [0.0, 3.0, 0.0]]).double()
    torch.testing.assert_close(axis_angle_from_rotation(rotation_from_axis_angle(angles)), angles)
    # A half turn about z may have either sign.
    found = axis_angle_from_rotation(torch.diag(torch.tensor([-1.0, -1.0, 1.0])))
    torch.testing.assert_close(found.abs(), torch.tensor([0.0, 0.0, torch.pi]))


def test_first_order_descriptors_of_offset_points_match_exact_ones() -> None:
    """Above a face of a rotated box, which is flat, the first order is exact."""
    rig = box_rig()
    root = torch.eye(4)[None]
    root[0, :2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    bodies = PosedBodies(rig, torch.zeros(1, 2, 3), root, rig.vertices_m)
    points_m, frame = torch.tensor([[-0.4, 0.6, 1.02], [-0.45, 0.5, 0.98]]), torch.zeros(2, dtype=torch.long)
    beside_m = torch.tensor([[[0.01, 0.0, 0.005]] * 2, [[0.0, -0.01, 0.0]] * 2])
    found, _ = bodies.describe_by_limbs(points_m, frame, 0.1, beside_m=beside_m)
    asked = bodies.describe((points_m + beside_m).flatten(0, 1), frame.repeat(2), 0.1)
    for name in ("d", "y"):
        torch.testing.assert_close(getattr(found, name), getattr(asked, name), atol=1e-5, rtol=0)


def test_a_shape_moves_vertices_as_skinning_does() -> None:
    """The whole body is in a bent pose, and joints move with the shape. The linear displacement of each vertex equals
    the result of skinning the other shape, because skinning is linear in the shape."""
    rig = anny_rig().to(dtype=torch.float64)
    generator = torch.Generator().manual_seed(2)
    theta = torch.randn(1, len(rig.joints_m), 3, generator=generator, dtype=torch.float64) * 0.4 * rig.free[:, None]
    root = torch.eye(4, dtype=torch.float64)[None]
    bodies = PosedBodies(rig, theta, root, rig.vertices_m)
    correction = bodies.correction().double()
    change = torch.randn(len(rig.beta), generator=generator, dtype=torch.float64)
    correction.shape.data.copy_(change)
    vertices = torch.arange(len(rig.vertices_m))
    found = bodies._displacement(bodies.vertices_m[0], torch.zeros_like(vertices), vertices, correction)
    expected = pose_vertices(rig.reshaped(rig.beta + change), theta, root) - bodies.vertices_m
    torch.testing.assert_close(found, expected[0], atol=1e-9, rtol=0)


def test_blending_by_hand_and_its_gradient_in_double():
    """Rows 1 and 2 are blended with weights of a quarter and three quarters; row 0 is used twice. The gradient of a row
    is the sum of its weights."""
    rows = torch.tensor([[1.0, 10.0], [2.0, 20.0], [4.0, 40.0]], dtype=torch.float64, requires_grad=True)
    corners, weights = torch.tensor([[1, 2], [0, 0]]), torch.tensor([[0.25, 0.75], [0.5, 0.5]])
    mixed = weighted_sum(rows, corners, weights)
    assert mixed.tolist() == [[3.5, 35.0], [1.0, 10.0]]
    mixed[:, 0].sum().backward()
    assert rows.grad is not None
    assert rows.grad.tolist() == [[1, 0], [0.25, 0], [0.75, 0]]
    assert torch.autograd.gradcheck(lambda r: weighted_sum(r, corners, weights), (rows,))


def test_distinct_rows_and_their_indices():
    """Of six rows, 1 and 4 occur. Row -1 means the last one."""
    present, own = distinct_rows(torch.tensor([4, 1, 1, 4]), 6)
    assert (present.tolist(), own.tolist()) == ([1, 4], [1, 0, 0, 1])
    present, own = distinct_rows(torch.tensor([2, -1]), 6)
    assert (present.tolist(), own.tolist()) == ([2, 5], [0, 1])

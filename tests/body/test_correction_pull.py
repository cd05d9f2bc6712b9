import pytest
import torch
from torch import Tensor

from hnerf.body.correction_pull import Displacement


def displacement_reference(
    twists: Tensor,
    bulge: Tensor,
    carried: Tensor,
    points: Tensor,
    posed: Tensor,
    share: Tensor,
    linear: Tensor,
    skin_joints: Tensor,
    skin_weights: Tensor,
) -> Tensor:
    """Return the same as `Displacement`, in plain torch. Memory grows with points x chains."""
    frame, vertex = posed.long() // len(share), posed.long() % len(share)
    turn, shift = (share[vertex, :, None, None] * twists[frame]).sum(1).unbind(1)
    rigid = (skin_weights[vertex, :, None] * carried[frame[:, None], skin_joints.long()[vertex]]).sum(1)
    return torch.linalg.cross(turn, points) + shift + (linear[posed.long()] @ bulge[vertex, :, None])[..., 0] + rigid


def test_displacements_and_their_gradients_match_plain_torch() -> None:
    """Two frames of a body of 5 vertices, 3 chains of joints and 4 joints, in double precision."""
    random = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=random, dtype=torch.float64)

    share = rand(5, 3) * torch.tensor([1.0, 0.0, 1.0])
    joints = torch.randint(4, (5, 2), generator=random).int()
    posed = torch.tensor([0, 4, 5, 9, 9, 2]).int()
    bodies = (rand(6, 3), posed, share, rand(10, 3, 3), joints, rand(5, 2))
    pull, found = rand(6, 3), []
    learned = [rand(2, 3, 2, 3), rand(5, 3), rand(2, 4, 3)]
    for displacement in (Displacement.apply, displacement_reference):
        inputs = [values.clone().requires_grad_() for values in learned]
        moved = displacement(*inputs, *bodies)
        moved.backward(pull)
        found.append([moved.detach(), *(values.grad for values in inputs)])
    for mine, plain in zip(*found, strict=True):
        torch.testing.assert_close(mine, plain, atol=1e-12, rtol=1e-12)
    inputs = [values.requires_grad_() for values in learned]
    with pytest.raises(RuntimeError, match="no second derivatives"):
        torch.autograd.grad(Displacement.apply(*inputs, *bodies).sum(), inputs, create_graph=True)

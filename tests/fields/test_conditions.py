"""Conditions of the networks, and the random numbers of a training step."""

import torch
from torch import Tensor

from hnerf.body.canonical import PosedBodies
from hnerf.fields.conditions import Conditions, Draws
from tests.body.two_bone import two_bone_rig


def test_conditions_by_hand() -> None:
    """One of three joints is free. T's translation of (1, 2, 3) m is given in scene units of 2 m."""
    theta, root = torch.arange(9.0).view(1, 3, 3), torch.eye(4)[None].clone()
    root[0, :2, :2] = torch.tensor([[0.0, -1], [1, 0]])
    root[0, :3, 3] = torch.tensor([1.0, 2, 3])
    rig = two_bone_rig().to(dtype=torch.float32)
    found = Conditions.of(PosedBodies(rig, theta, root, rig.vertices_m), torch.tensor([5]), 2.0)
    assert found.pose.tolist() == [[3, 4, 5]]
    assert found.root.tolist() == [[0, -1, 0, 0.5, 1, 0, 0, 1, 0, 0, 1, 1.5]]
    assert found.frame_row.tolist() == [5]


def expect_gaussian_noise(noise: Tensor) -> None:
    """Assert that each column has a mean of 0 and a standard deviation of 0.1."""
    assert (noise.mean(0).abs() < 0.01).all()
    assert ((noise.std(0) - 0.1).abs() < 0.01).all()


def test_noise_on_pose_and_root() -> None:
    """Every number of every frame gets its own Gaussian noise; the frame row is unchanged."""
    given = Conditions(torch.full((2000, 3), 0.7), torch.full((2000, 12), -0.3), torch.arange(2000))
    noisy = given.with_noise(0.1, torch.Generator().manual_seed(0))
    both = torch.cat([noisy.pose - given.pose, noisy.root - given.root], 1)
    expect_gaussian_noise(both)
    apart = torch.corrcoef(both.T) - torch.eye(15)
    assert apart.abs().max() < 0.1
    assert 0.002 < (both.abs() > 0.3).float().mean() < 0.0035  # 0.0027 of a Gaussian lie beyond 3 sigma
    assert torch.equal(noisy.frame_row, given.frame_row)


def test_random_draws_of_a_training_step() -> None:
    """Draws are uniform numbers in [0, 1) and Gaussian noise on directions, all uncorrelated."""
    draws = Draws.random(2000, 3, 0.1, torch.Generator().manual_seed(0))
    assert draws.view is not None and draws.probe is not None
    expect_gaussian_noise(draws.view)
    uniform = torch.cat([draws.jitter, draws.fine, draws.background, draws.probe[:, None]], 1)
    assert uniform.shape == (2000, 10) and uniform.min() >= 0 and uniform.max() < 1
    assert (uniform.mean(0) - 0.5).abs().max() < 0.03 and (uniform.std(0) - 12**-0.5).abs().max() < 0.02
    apart = torch.corrcoef(torch.cat([uniform, draws.view], 1).T) - torch.eye(13)
    assert apart.abs().max() < 0.1


def test_rendering_uses_no_random_numbers() -> None:
    """Samples lie in the middle of their strata, over black, without noise or regularisation."""
    still = Draws.deterministic(2, 3, torch.device("cpu"))
    assert (still.jitter == 0.5).all() and (still.fine == 0.5).all() and not still.background.any()
    assert still.view is None and still.probe is None

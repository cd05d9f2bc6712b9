import torch

from hnerf.field.mlp import RadianceMLP, ResidualMLP, SkipMLP


def test_sizes_of_the_paper():
    """F: eight layers of 256, the fifth sees the input again; DH: six of 128."""
    radiance = RadianceMLP(4, 57, 12)
    inputs = 4 * 17 + 57
    assert [layer.in_features for layer in radiance.trunk.layers] == [
        inputs,
        256,
        256,
        256,
        256 + inputs,
        256,
        256,
        256,
    ]
    residual = ResidualMLP(4, 57)
    assert [layer.out_features for layer in residual.trunk.layers] == [128] * 6
    inputs = 4 * 3 + 57  # one octave
    assert [layer.in_features for layer in residual.trunk.layers] == [inputs, 128, 128, 128 + inputs, 128, 128]


def test_density_does_not_see_root_or_view():
    network = RadianceMLP(4, 3, 12)
    point, pose = torch.rand(5, 4), torch.rand(5, 3)
    one = network(point, pose, torch.zeros(5, 12), torch.zeros(5, 3))
    two = network(point, pose, torch.ones(5, 12), torch.ones(5, 3))
    assert torch.equal(one[0], two[0])
    assert not torch.equal(one[1], two[1])


def test_density_colour_and_distance_see_the_pose():
    radiance, residual = RadianceMLP(4, 3, 12), ResidualMLP(4, 3)
    torch.nn.init.normal_(residual.residual.weight)
    point, root, view = torch.rand(5, 4), torch.rand(5, 12), torch.rand(5, 3)
    poses = torch.zeros(5, 3), torch.ones(5, 3)
    one, two = ([*radiance(point, pose, root, view), residual(point, pose)] for pose in poses)
    assert not any(torch.equal(here, there) for here, there in zip(one, two, strict=True))


def test_residual_starts_at_zero():
    assert ResidualMLP(4, 3)(torch.rand(5, 4), torch.rand(5, 3)).abs().max() == 0


def test_gradients_in_double():
    network = SkipMLP(2, 3, 4).double()
    x = torch.rand(3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(network, (x,)) and torch.autograd.gradgradcheck(network, (x,))

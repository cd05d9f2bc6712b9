import torch

from hnerf.fields.mlp import RadianceMLP, ResidualMLP, SkipMLP


def test_networks_have_the_papers_sizes():
    """F has eight layers of 256, and its fifth layer takes the input again; DH has six layers of 128."""
    radiance = RadianceMLP(4, 57, 12)
    inputs = 4 * 17 + 57
    widths = [inputs, 256, 256, 256, 256 + inputs, 256, 256, 256]
    assert [layer.in_features for layer in radiance.trunk.layers] == widths
    residual = ResidualMLP(4, 57)
    assert [layer.out_features for layer in residual.trunk.layers] == [128] * 6
    inputs = 4 * 3 + 57  # encoded with one octave
    assert [layer.in_features for layer in residual.trunk.layers] == [inputs, 128, 128, 128 + inputs, 128, 128]


def test_density_is_independent_of_root_and_view():
    network = RadianceMLP(4, 3, 12)
    point, pose = torch.rand(5, 4), torch.rand(5, 3)
    one = network(point, pose, torch.zeros(5, 12), torch.zeros(5, 3))
    two = network(point, pose, torch.ones(5, 12), torch.ones(5, 3))
    assert torch.equal(one[0], two[0])
    assert not torch.equal(one[1], two[1])


def test_density_colour_and_distance_depend_on_the_pose():
    radiance, residual = RadianceMLP(4, 3, 12), ResidualMLP(4, 3)
    torch.nn.init.normal_(residual.residual.weight)
    point, root, view = torch.rand(5, 4), torch.rand(5, 12), torch.rand(5, 3)
    poses = torch.zeros(5, 3), torch.ones(5, 3)
    one, two = ([*radiance(point, pose, root, view), residual(point, pose)] for pose in poses)
    assert not any(torch.equal(here, there) for here, there in zip(one, two, strict=True))


def test_the_residual_network_starts_at_zero():
    assert ResidualMLP(4, 3)(torch.rand(5, 4), torch.rand(5, 3)).abs().max() == 0


def test_gradients_match_finite_differences():
    network = SkipMLP(2, 3, 4).double()
    x = torch.rand(3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(network, (x,)) and torch.autograd.gradgradcheck(network, (x,))


def slopes(network: SkipMLP, points: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Return values, their gradients by the points, and the gradients by the parameters of a loss on both, as `eikonal`
    needs them."""
    points = points.clone().requires_grad_()
    values = network(points).float()
    (slope,) = torch.autograd.grad(values.sum(), points, create_graph=True)
    loss = values.square().mean() + ((slope.norm(dim=1) - 1) ** 2).mean()
    return values, slope, *torch.autograd.grad(loss, list(network.parameters()))


def test_bfloat16_products_have_errors_of_at_most_a_few_percent():
    """A mantissa of eight bits has an error of 0.4 % in each of eight layers. Tensors saved for gradients are in
    bfloat16 too."""
    torch.manual_seed(0)
    network, points, saved = SkipMLP(30, 256, 8), torch.randn(1000, 30), []  # 30 inputs: not a multiple of 8
    for layer in network.layers:
        torch.nn.init.kaiming_normal_(layer.weight)

    def kept(tensor: torch.Tensor) -> torch.Tensor:
        storages[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    for network.bf16 in (False, True):
        storages: dict[int, int] = {}
        with torch.autograd.graph.saved_tensors_hooks(kept, lambda tensor: tensor):
            network(points)
        saved.append(sum(storages.values()))
    assert saved[1] < 0.65 * saved[0]
    reduced = slopes(network, points)
    network.bf16 = False
    for exact, found in zip(slopes(network, points), reduced, strict=True):
        assert found.dtype == torch.float32
        assert 1e-3 < (found - exact).norm() / exact.norm() < 0.03


def test_radiance_in_bfloat16_matches_single_precision_up_to_rounding():
    """Density and colour are returned in single precision; the colour's hidden layer multiplies in bfloat16 too."""
    torch.manual_seed(0)
    exact, reduced = RadianceMLP(4, 57, 12), RadianceMLP(4, 57, 12, bf16=True)
    reduced.load_state_dict(exact.state_dict())
    inputs = torch.randn(500, 4), torch.randn(500, 57), torch.randn(500, 12), torch.randn(500, 3)
    for one, two in zip(exact(*inputs), reduced(*inputs), strict=True):
        assert two.dtype == torch.float32
        assert 1e-4 < (two - one).norm() / one.norm() < 0.03


def test_initial_density_varies_over_space():
    """With torch's default initial weights, its standard deviation would be below 0.001."""
    torch.manual_seed(0)
    network = RadianceMLP(4, 57, 12)
    density, _ = network(2 * torch.rand(500, 4) - 1, torch.zeros(500, 57), torch.zeros(500, 12), torch.zeros(500, 3))
    assert density.std() > 0.01


def test_view_directions_are_encoded_if_octaves_are_set():
    """(v, sin pi v, cos pi v) are nine inputs instead of three. Views of 1 and -1 differ only in v."""
    network = RadianceMLP(4, 3, 12, view_octaves=1)
    assert network.colour[0].in_features == 256 + 12 + 9
    with torch.no_grad():
        network.colour[0].weight[:, 268:271] = 0  # weights of v
    point, pose, root = torch.rand(2, 4), torch.rand(2, 3), torch.rand(2, 12)
    one, other = (network(point, pose, root, torch.full((2, 3), v))[1] for v in (1.0, -1.0))
    torch.testing.assert_close(one, other)
    assert not torch.allclose(one, network(point, pose, root, torch.full((2, 3), 0.5))[1])

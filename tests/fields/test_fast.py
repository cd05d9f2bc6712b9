"""The fast field: its shell, which is tightened to the visible part and outside of which nothing is evaluated, and the
surface that rays see."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hnerf.body.canonical import Descriptor, PosedBodies
from hnerf.config import FastFieldSettings
from hnerf.fields.base import Field, composited
from hnerf.fields.conditions import Conditions, Draws
from hnerf.fields.fast import MOST_RENDERED, FastField, least_around, least_of_limbs, move_to_surface, shown
from hnerf.fields.rays import PosedScene, Rays
from hnerf.geometry.camera import Camera
from hnerf.training.losses import pixel_colour
from tests.body.boxes import box_rig
from tests.body.test_limbs import limbs_rig, swung

RIG = box_rig(splits=3)
SETTINGS = FastFieldSettings(
    outer_m=0.07,
    inner_m=0.03,
    spacing_m=0.01,
    geometry_cells=(4,),
    colour_cells=(4,),
    width=8,
    pose_width=8,
    shell_cell_m=0.05,
)


def standing() -> tuple[PosedBodies, Conditions]:
    bodies = PosedBodies(RIG, torch.zeros(1, 2, 3), torch.eye(4)[None], RIG.vertices_m)
    return bodies, Conditions.of(bodies, torch.zeros(1).long(), 2.5)


def field_of(sharpness_per_m: float, settings: FastFieldSettings = SETTINGS) -> FastField:
    torch.manual_seed(0)
    field = FastField(RIG, settings, 1)
    field.log_sharpness.data.fill_(sharpness_per_m).log_()
    return field


def from_above(*origins_m: tuple[float, float, float]) -> Rays:
    """Return rays along -z in the frame of the first body."""
    down = torch.tensor([[0.0, 0.0, -1.0]]).expand(len(origins_m), 3)
    return Rays(torch.tensor(origins_m), down, torch.zeros(len(origins_m), dtype=torch.long))


def test_a_tightened_shell_renders_the_same_image():
    bodies, conditions = standing()
    field = field_of(1000.0)
    rays = from_above((0.5, 0.4, 3.0), (0.31, 0.62, 3.0), (0.1, 0.8, 3.0))
    draws = Draws.deterministic(3, 32, torch.device("cpu"))

    def coverage() -> torch.Tensor:
        return field.coverage(field.sample(field.scene(bodies, conditions), rays, draws)[0])

    before = coverage()
    field.tighten(RIG, conditions.pose)
    torch.testing.assert_close(coverage(), before, atol=0.01, rtol=0)
    assert (before > 0.95).all()


def test_rays_that_miss_the_shell_are_empty_and_do_not_affect_others():
    """The middle one of three rays passes 1 m from the box; the results of the others do not depend on it."""
    bodies, conditions = standing()
    field = field_of(100.0)
    rays = from_above((0.5, 0.5, 3.0), (2.0, 0.5, 3.0), (0.4, 0.6, 3.0))
    scene = field.scene(bodies, conditions)

    def sampled(pick: list[int]) -> list[torch.Tensor]:
        draws = Draws.deterministic(len(pick), 32, torch.device("cpu"))
        found, _ = field.sample(scene, rays.pick(torch.tensor(pick)), draws)
        return [found.alpha, found.colour, found.d, found.residual]

    alpha, colour, d, residual = sampled([0, 1, 2])
    assert not alpha[1].any() and not colour[1].any() and not residual[1].any()
    assert (d[1] == field.reach_m).all()
    assert not sampled([1])[0].any()
    draws = Draws.random(1, 5, 0.0, torch.Generator())
    assert field.sample(scene, rays.pick(torch.tensor([1])), draws)[0].gradient_norm.shape == (0,)
    for all_three, alone in zip((alpha, colour, d, residual), sampled([0, 2]), strict=True):
        torch.testing.assert_close(all_three[[0, 2]], alone, atol=1e-6, rtol=0)


def test_samples_beyond_the_shell_thickness_are_out_of_reach():
    """Cells of 5 cm put samples 7 cm and more above the box; those above 2 cm are out of reach."""
    bodies, conditions = standing()
    field = field_of(100.0)
    field.outer_m.fill_(0.02)
    draws = Draws.deterministic(1, 64, torch.device("cpu"))
    found, depths = field.sample(field.scene(bodies, conditions), from_above((0.5, 0.4, 3.0)), draws)
    above_m = 3.0 - depths[0] - RIG.vertices_m[:, 2].max()
    far, close = above_m > 0.0201, (above_m > 0) & (above_m < 0.0199)
    assert far.any() and close.any()
    assert (found.d[0, far] == field.reach_m).all()
    torch.testing.assert_close(found.d[0, close], above_m[close], atol=1e-4, rtol=0)


def test_pixels_within_the_shell_and_a_cell_are_visible():
    """The shell of 7 cm and a cell of 5 cm, at 210 m with a focal length of 5000 px, are 2.9 px, rounded up."""
    camera = Camera("afar", np.diag([5000.0, 5000.0, 1.0]), np.eye(3), np.zeros(3), 60, 40)
    seen = field_of(100.0).visible_pixels(camera, 210 * np.array([[20 / 5000, 20 / 5000, 1.0]]))
    assert np.flatnonzero(seen[20]).tolist() == [*range(17, 24)]


def test_as_many_samples_as_paths_require_render_the_same_as_many():
    """Straight and slanted rays with different path lengths in the shell, and one that misses it, agree with samples
    1 mm apart. Each sees the same alone as among others."""
    bodies, conditions = standing()
    field = field_of(200.0)
    origins = torch.tensor([[0.5, 0.4, 3.0], [0.02, 0.9, 3.0], [0.5, 0.1, 3.0], [2.0, 0.5, 3.0]])
    directions = torch.tensor([[0.0, 0.0, -1.0], [0.0, -0.02, -1.0], [0.05, 0.1, -1.0], [0.0, 0.0, -1.0]])
    directions = torch.nn.functional.normalize(directions, dim=-1)
    rays = Rays(origins, directions, torch.zeros(4, dtype=torch.long))
    scene = field.scene(bodies, conditions)
    found = field.render_rays(scene, rays)
    many = field.sample(scene, rays, Draws.deterministic(4, 512, torch.device("cpu"), 0.001))
    torch.testing.assert_close(found, composited(*many), atol=0.02, rtol=0)
    assert (found[:3, 3] > 0.5).all() and not found[3].any()
    for k in range(4):
        torch.testing.assert_close(field.render_rays(scene, rays.pick(torch.tensor([k])))[0], found[k])


@pytest.mark.parametrize(
    ("path_m", "pixel_m", "samples"),
    [(0.1, None, 10), (0.1, 0.1, 10), (0.1, 0.002, 13), (0.1, 1e-6, 34), (0.04, None, 6), (9.0, None, MOST_RENDERED)],
)
def test_samples_are_four_pixels_apart_in_close_ups(path_m: float, pixel_m: float | None, samples: int):
    """10 cm of shell in samples of 10 mm, of 8 mm if a pixel covers 2 mm, and of 3 mm at the closest are 10, 12.5 and
    33.3 samples. No ray has fewer than 6."""
    region = SimpleNamespace(path_m=lambda rays: (torch.tensor([path_m - 1e-6]), torch.tensor([2.0])))
    bodies, conditions = standing()
    scene = PosedScene(bodies, region, conditions, pixel_rad=pixel_m and pixel_m / 2)
    draws = field_of(200.0).rendering_draws(scene, from_above((0.5, 0.5, 3.0)))
    assert draws.jitter.shape == (1, samples) and draws.spacing_m is not None
    assert draws.spacing_m.item() == pytest.approx(min(0.01, max(0.003, 4 * (pixel_m or 1))))


@pytest.mark.parametrize("sharpness_per_m", [100.0, 2000.0])
def test_depth_is_that_of_the_surface(sharpness_per_m: float):
    """The top of the box is at z = 1 m, 2 m below the camera."""
    bodies, conditions = standing()
    field = field_of(sharpness_per_m)
    rays = from_above((0.5, 0.4, 3.0), (0.31, 0.62, 3.0013), (0.5, 0.5, 3.007))
    depth_m = field.render_rays(field.scene(bodies, conditions), rays)[:, 4]
    torch.testing.assert_close(depth_m, rays.origins_m[:, 2] - RIG.vertices_m[:, 2].max(), atol=1e-3, rtol=0)


def deeper_by(distance_m: float, settings: FastFieldSettings = SETTINGS) -> FastField:
    """Return a field whose surface lies deeper than the body everywhere in the shell."""
    field = field_of(500.0, settings)
    last = field.field.geometry[-1]
    assert isinstance(last, torch.nn.Linear)
    last.bias.data.fill_(distance_m / settings.outer_m)
    return field


def test_rendered_rays_end_at_the_solid_core_if_the_surface_lies_deeper():
    """The surface lies 10 cm inside the body and the shell is 3 cm deep, so no sample reaches the surface. A ray
    through the middle is opaque nevertheless, at its last sample and with that sample's colour. A ray that grazes the
    shell sees nothing."""
    bodies, conditions = standing()
    field = deeper_by(0.1)
    rays = from_above((0.5, 0.5, 3.0), (-0.05, 0.5, 3.0))
    scene = field.scene(bodies, conditions)
    with torch.no_grad():
        draws = field.rendering_draws(scene, rays)
        _, (last, _), _ = scene.region.sample_rays(rays, draws.jitter, draws.spacing_m)
        samples, depths = field.sample(scene, rays, draws)
        seen = field.render_rays(scene, rays)
    assert samples.d_hat.min() > 0.02 and field.coverage(samples).max() < 0.01
    assert seen[0, 3] == pytest.approx(1) and seen[0, 4] == pytest.approx(depths[0, last - 1].item(), abs=1e-4)
    torch.testing.assert_close(seen[0, :3], samples.colour[0, last - 1], atol=1e-3, rtol=0)
    assert samples.colour[0, last - 1].min() > 0 and seen[1, 3] < 0.01


def test_a_shell_with_more_depth_than_height_finds_a_deep_surface():
    """The shell extends 3 cm outwards and 10 cm inwards. The surface lies 7 cm inside the body, farther from the skin
    than the outer thickness."""
    settings = SETTINGS.model_copy(update={"outer_m": 0.03, "inner_m": 0.1, "shell_cell_m": 0.015})
    bodies, conditions = standing()
    field = deeper_by(0.07, settings)
    field.tighten(RIG, conditions.pose)
    with torch.no_grad():
        seen = field.render_rays(field.scene(bodies, conditions), from_above((0.5, 0.5, 3.0)))[0]
    top_m = 3 - bodies.vertices_m[0, :, 2].max().item()
    assert seen[3] == pytest.approx(1, abs=0.01) and seen[4].item() - top_m == pytest.approx(0.07, abs=0.01)


def test_neighbouring_rays_are_rendered_as_if_alone():
    """The rays are a hundredth of a radian off two rays that hit a flat face; colours differ between them."""
    bodies, conditions = standing()
    field = field_of(2000.0)
    torch.nn.init.normal_(field.field.colour_grids.features, std=30.0)
    down = torch.tensor([[0.1, 0.0, -1.0], [0.0, 0.0, -1.0]])
    rays = Rays(
        torch.tensor([[0.4, 0.4, 2.5], [0.6, 0.5, 2.5]]),
        torch.nn.functional.normalize(down, dim=1),
        torch.zeros(2).long(),
    )
    beside = torch.tensor([[[0.01, 0.0, 0.0]], [[0.0, 0.01, 0.0]], [[-0.01, 0.0, 0.0]]])
    directions = torch.nn.functional.normalize(rays.directions + beside, dim=-1)
    with torch.no_grad():
        scene = field.scene(bodies, conditions)
        found, alone = field.render_beside(scene, rays, directions), Field.render_beside(field, scene, rays, directions)
        between = field.render_rays(scene, rays)
    torch.testing.assert_close(found, alone, atol=2e-3, rtol=0)
    assert found[..., 3].min() > 0.99 and (found[..., :3] - between[:, :3]).abs().max() > 0.02


def test_only_samples_of_some_weight_are_coloured() -> None:
    """These are samples with a weight above 0.01, or above half of the largest on a ray that is nearly empty."""
    weights = torch.tensor([[0.02, 0.009, 0.9, 0.011], [0.004, 0.001, 0.003, 0.0]])
    assert shown(weights).tolist() == [[True, False, True, True], [True, False, True, False]]


def test_samples_of_low_weight_do_not_darken_the_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    """The surface is so soft that many samples have a low weight. They count as white, like the others, not as
    black."""
    bodies, conditions = standing()
    field = field_of(40.0)
    monkeypatch.setattr(type(field.field), "colour", lambda _, y, *__: torch.ones_like(y))
    draws = Draws.deterministic(1, 64, torch.device("cpu"))
    with torch.no_grad():
        samples, depths = field.sample(field.scene(bodies, conditions), from_above((0.5, 0.4, 3.0)), draws)
    seen = composited(samples, depths)[0]
    assert 3 < int((samples.colour[0, :, 0] > 0).sum()) < 64
    torch.testing.assert_close(seen[:3], seen[3].expand(3))


def test_the_shell_moves_with_the_displacement_of_a_frame():
    """For a frame displaced by 2 cm, the shell is 2 cm higher. For one displaced by 10 cm, its upper end stops at the
    setting of 7 cm, which is 5 cm higher, and its lower end a cell of 1 cm inside the body, which is 6 cm higher."""
    settings = SETTINGS.model_copy(update={"nodes": 1, "shell_cell_m": 0.01, "inner_m": 0.1})
    field = FastField(RIG, settings, 2)
    assert field.deformation is not None
    field.outer_m.fill_(0.02)
    field.inner_m.fill_(0.07)
    field.deformation.displacement.data[:2, 0, 2] = torch.tensor([0.02, 0.1])
    bodies, _ = standing()

    def ends(moment: int) -> torch.Tensor:
        """Return the depths of the first and the last sample on a ray from above."""
        moments = Conditions.of(bodies, torch.tensor([moment]), 2.5)
        depths, _, core = field.region(bodies, moments).sample_rays(
            from_above((0.5, 0.5, 3.0)), torch.full((1, 64), 0.5)
        )
        assert core.all()
        return depths[0, [0, -1]]

    still = ends(-1)
    torch.testing.assert_close(still - ends(0), torch.tensor([0.02, 0.02]), atol=0.011, rtol=0)
    torch.testing.assert_close(still - ends(1), torch.tensor([0.05, 0.06]), atol=0.011, rtol=0)


def test_every_parameter_learns() -> None:
    """A column that is overfitted does not show it: networks on frozen grids do so, too."""
    field = field_of(1000.0)
    groups = [parameter for group in field.parameter_groups() for parameter in group["params"]]
    assert len(groups) == len(list(field.parameters()))
    assert {id(parameter) for parameter in groups} == {id(parameter) for parameter in field.parameters()}


def test_training_starts_with_twice_the_spacing():
    """In three quarters of the steps, samples are 2 cm apart, then 1 cm, on paths of up to 64 cm."""
    field = FastField(RIG, SETTINGS, 1)
    early, late = (32, 0.02), (64, 0.01)
    assert [field.training_samples(done) for done in (0.0, 0.74, 0.75, 1.0)] == [early, early, late, late]


@pytest.mark.parametrize(("ends_in_core", "spacing_m"), [(True, 0.015), (False, 0.03)])
def test_padding_changes_nothing(ends_in_core: bool, spacing_m: float) -> None:
    """Two rays together, with paths of different lengths through the shell: each has the colour, opacity, losses and
    gradients that it has alone, where it has no padding."""
    settings = SETTINGS.model_copy(update={"nodes": 2})
    field = field_of(60.0, settings)
    torch.nn.init.normal_(field.field.colour_grids.features, std=10.0)
    torch.nn.init.normal_(field.field.geometry_grids.features, std=1.0)
    assert field.deformation is not None
    torch.nn.init.normal_(field.deformation.displacement, std=0.01)
    bodies, conditions = standing()
    scene = dataclasses.replace(field.scene(bodies, conditions), correction=bodies.correction())
    slanted = torch.nn.functional.normalize(torch.tensor([[0.0, 0.0, -1.0], [0.9, 0.1, -1.0]]), dim=1)
    origins_m = torch.tensor([[0.45, 0.4, 3.0], [-2.0 if ends_in_core else -2.1, 0.3, 3.0]])
    rays = Rays(origins_m, slanted, torch.zeros(2).long())
    if not ends_in_core:
        scene.region.cells[scene.region.cells == 2] = 1
    draws = Draws.random(2, 64, 0.0, torch.Generator().manual_seed(0), spacing_m)
    _, count, core = scene.region.sample_rays(rays, draws.jitter, draws.spacing_m)
    few, many = sorted(count.tolist())
    assert 6 < few < many < 64 and core.all() == ends_in_core

    def seen(which: list[int], samples: int) -> list[torch.Tensor]:
        picked = {f.name: getattr(draws, f.name)[which] for f in dataclasses.fields(draws)}
        own = Draws(**picked | {"jitter": picked["jitter"][:, :samples]})
        found, depths = field.sample(scene, rays.pick(torch.tensor(which)), own)
        assert found.elastic is not None
        total = pixel_colour(found.alpha, found, own.background).sum() + found.elastic.sum() + found.gradient_norm.sum()
        parameters = [field.deformation.displacement, *field.field.parameters()]  # type: ignore[union-attr]
        gradients = torch.autograd.grad(total + torch.relu(-found.d_hat).sum(), parameters, allow_unused=True)
        images = composited(found, depths), found.elastic, found.gradient_norm, torch.relu(-found.d_hat).sum(1)
        return [*images, *(g if g is not None else torch.zeros(1) for g in gradients)]

    together = seen([0, 1], 64)
    alone = [seen([ray], int(count[ray])) for ray in (0, 1)]
    for both, first, second in zip(together[:4], *(values[:4] for values in alone), strict=True):
        torch.testing.assert_close(both, torch.cat([first, second]))
    for both, first, second in zip(together[4:], *(values[4:] for values in alone), strict=True):
        torch.testing.assert_close(both, first + second, atol=1e-4, rtol=1e-3)


def on_a_ray(depth_m: list[float], near: list[bool]) -> Descriptor:
    """Return descriptors of the samples of one ray that meets the skin z = 0 perpendicularly, at given heights above
    it."""
    d, zero = torch.tensor(depth_m), torch.zeros(len(depth_m))
    y = torch.stack([zero, zero, d], 1)
    return Descriptor(d, y, y, torch.tensor(near), torch.zeros(len(d), 3).long(), torch.zeros(len(d), 3))


def last_of(*counts: int) -> torch.Tensor:
    """Return which samples are the last of their rays, of `counts` samples each."""
    return torch.cat([torch.arange(count) == count - 1 for count in counts])


def on_surface(described: Descriptor, d_hat: torch.Tensor, ends: torch.Tensor) -> Descriptor:
    return move_to_surface(described, d_hat, -described.d, ends)[0]


def test_samples_in_front_of_the_surface_move_onto_it():
    """Samples lie at 12, 6, -2 and -8 mm above the skin, the surface at 1 mm. The second sample moves 5 / 8 of the way
    to the third, and the first moves to the second. Those behind the surface stay."""
    described = on_a_ray([0.012, 0.006, -0.002, -0.008], [True] * 4)
    moved, depth_m = move_to_surface(described, described.d - 0.001, -described.d, last_of(4))
    expected = torch.tensor([0.006, 0.001, -0.002, -0.008])
    assert torch.allclose(depth_m, -expected, atol=1e-7)
    assert torch.allclose(moved.d, expected, atol=1e-7)
    assert torch.allclose(moved.y[:, 2], expected, atol=1e-7)


def test_samples_stay_if_the_next_is_out_of_reach_or_near_another_limb():
    described = on_a_ray([0.005, -0.005, 0.005, 0.006], [True, False, True, True])
    described.y[3, 0] = 0.1
    moved = on_surface(described, described.d, last_of(4))
    for name in ("d", "y", "corners", "barycentric"):
        assert torch.equal(getattr(moved, name), getattr(described, name))


@pytest.mark.parametrize("first_near", [True, False])
def test_a_sample_in_front_of_another_limb_moves_onto_that_limb(first_near):
    """The first sample is 5 mm from an arm, or out of reach; the next two are 1 and 6 mm inside the trunk. The path
    between the first two is opaque because of the trunk, whose surface is a fifth of a step before the second
    sample."""
    described = on_a_ray([0.005, -0.001, -0.006], [first_near, True, True])
    described.y[1:, 0] = 0.1
    described.corners[1:], described.barycentric[1:] = 7, 0.5
    moved = on_surface(described, described.d, last_of(3))
    on_trunk = torch.tensor([[0.1, 0, 0], [0.1, 0, 0], [0.1, 0, -0.006]])
    torch.testing.assert_close(moved.y, on_trunk, atol=1e-7, rtol=0)
    torch.testing.assert_close(moved.d, on_trunk[:, 2], atol=1e-7, rtol=0)
    for name in ("corners", "barycentric"):
        assert torch.equal(getattr(moved, name), getattr(described, name)[[1, 1, 2]])


def test_the_least_distance_along_a_ray_is_interpolated_between_samples():
    """The distance is (t^2 + 2) mm at t = -1.75, -0.75, 0.25 and 1.25 steps, so the least is 2 mm. It is not
    interpolated at the ends, nor if a neighbour is out of reach or on another limb."""
    d_hat, ends = 1e-3 * (torch.tensor([-1.75, -0.75, 0.25, 1.25]).square() + 2), last_of(4)
    described = on_a_ray(d_hat.tolist(), [True] * 4)
    expected = d_hat.clone()
    expected[2] = 0.002
    torch.testing.assert_close(least_around(described, d_hat, ends), expected, atol=1e-7, rtol=0)
    assert torch.equal(least_around(on_a_ray(d_hat.tolist(), [True, True, True, False]), d_hat, ends), d_hat)
    assert torch.equal(least_around(described, d_hat, last_of(2, 2)), d_hat)  # on two rays
    described.y[3, 0] = 0.1
    assert torch.equal(least_around(described, d_hat, ends), d_hat)
    for few in (0, 1, 2):
        assert torch.equal(least_around(on_a_ray([0.01] * few, [True] * few), d_hat[:few], last_of(few)), d_hat[:few])


def test_the_surface_point_moves_correctly_with_its_body():
    """A ray descends at 45 degrees, 4 mm down and 4 mm along x per sample, from 3 mm above the skin at x = 0 to 1 mm
    below. It hits the skin at x = 3 mm. If the body moves along the ray by e, the ray hits the same point of it; if the
    body moves down by e, the ray hits it e farther along x."""
    x, height = torch.tensor([[0.0, 0.004], [0.003, -0.001]], dtype=torch.double)

    def met_at(points_on_rays: torch.Tensor, down: torch.Tensor) -> torch.Tensor:
        d = height + points_on_rays + down
        y = torch.stack([x - points_on_rays, torch.zeros_like(x), d], 1)
        described = dataclasses.replace(on_a_ray([0.0, 0.0], [True] * 2), d=d, y=y)
        return on_surface(described, d, last_of(2)).y[0]

    still = torch.zeros((), dtype=torch.double, requires_grad=True)
    skin = torch.tensor([0.003, 0.0, 0.0], dtype=torch.double)
    torch.testing.assert_close(met_at(still, still), skin, atol=1e-12, rtol=0)
    points_on_rays, down = torch.autograd.functional.jacobian(met_at, (still, still))
    torch.testing.assert_close(points_on_rays, torch.zeros_like(skin), atol=1e-9, rtol=0)
    torch.testing.assert_close(down, torch.tensor([1.0, 0.0, 0.0], dtype=torch.double), atol=1e-9, rtol=0)
    assert torch.autograd.gradcheck(met_at, (still, still), eps=1e-7)


def test_colour_gradients_by_the_body_position_match_finite_differences():
    """The gradients of a slanted ray's colour match central differences over 0.2 mm."""
    bodies, conditions = standing()
    field, correction = field_of(500.0), bodies.correction()
    del correction.move_m  # a plain tensor takes the parameter's place
    for grid in field.field.colour_grids.parameters():
        torch.nn.init.normal_(grid)
    direction = torch.nn.functional.normalize(torch.tensor([[0.4, 0.3, -1.0]]), dim=-1)
    rays = Rays(torch.tensor([[0.5, 0.4, 0.5]]) - 2 * direction, direction, torch.zeros(1, dtype=torch.long))
    draws = Draws.deterministic(1, 32, torch.device("cpu"))

    def colour(move_m: torch.Tensor) -> torch.Tensor:
        correction.move_m = move_m[None]
        scene = PosedScene(bodies, field.region(bodies, conditions), conditions, correction)
        samples, _ = field.sample(scene, rays, draws)
        return pixel_colour(samples.alpha, samples, draws.background)[0]

    step_m = 1e-4
    steps = [(colour(step_m * axis) - colour(-step_m * axis)) / (2 * step_m) for axis in torch.eye(3)]
    pull = torch.autograd.functional.jacobian(colour, torch.zeros(3))
    assert pull.abs().max() > 0.1
    torch.testing.assert_close(pull, torch.stack(steps, 1), atol=1e-3, rtol=0)


def test_a_ray_that_grazes_the_surface_has_finite_gradients():
    described = on_a_ray([0.001, 0.001, 0.0, 0.0], [True] * 4)
    d_hat = described.d.clone().requires_grad_()
    on_surface(described, d_hat, last_of(4)).y.sum().backward()
    assert d_hat.grad is not None
    assert torch.isfinite(d_hat.grad).all()


def test_samples_of_other_rays_are_no_neighbours() -> None:
    """Two rays with the same samples: each moves as if alone. So do rays of which one ends where the next begins inside
    another limb."""
    low = [0.012, 0.006, -0.002, -0.008]
    described = on_a_ray([*low, *low], [True] * 8)
    moved = on_surface(described, described.d - 0.001, last_of(4, 4))
    torch.testing.assert_close(moved.d, torch.tensor([0.006, 0.001, -0.002, -0.008] * 2), atol=1e-7, rtol=0)
    apart = on_a_ray([0.004, 0.002, -0.003, -0.006], [True] * 4)
    apart.y[2:, 0] = 0.1
    moved = on_surface(apart, apart.d, last_of(2, 2))
    torch.testing.assert_close(moved.d, torch.tensor([0.002, 0.002, -0.003, -0.006]), atol=1e-7, rtol=0)


def test_samples_stay_if_the_ray_moves_away_from_the_surface():
    described = on_a_ray([0.001, 0.004, 0.004, 0.009], [True] * 4)
    assert torch.equal(on_surface(described, described.d, last_of(4)).d, described.d)


def test_the_distance_is_the_minimum_over_limbs() -> None:
    """Point 0 is queried for two more limbs, and the last one has the least distance. Point 1 is deepest in its own
    limb, point 2 in another one."""
    d_hat = torch.tensor([3.0, -4.0, 2.0, 2.5, 1.0, -3.0, -1.0])
    assert least_of_limbs(d_hat, torch.tensor([0, 0, 1, 2])).tolist() == [4, 1, 6]


def test_a_trunks_shirt_is_found_even_at_points_closer_to_the_arm() -> None:
    """At 0.8 m below the shoulder, the arm is 4 cm from the trunk, and a shirt extends 3 cm from the trunk. A point 2.5
    cm from the trunk is less than 1.5 cm from the arm, but 5 mm inside the shirt, and a ray through it ends there."""
    rig, bodies = limbs_rig(), swung(0.2)
    field = FastField(rig, SETTINGS, 1)
    field.log_sharpness.data.fill_(2000.0).log_()
    field.field.residual = lambda y, d, pose, row: torch.where(y[:, 0] < 1.1, -0.03, 0.0)
    conditions = Conditions.of(bodies, torch.zeros(1).long(), 2.5)
    point_m = torch.tensor([[1.025, 0.05, 0.2]])
    assert bodies.describe(point_m, torch.zeros(1).long(), 1.0).y[0, 0] > 1.1
    assert field.signed_distance(bodies, point_m, conditions).item() == pytest.approx(-0.005, abs=1e-5)
    ray = Rays(point_m - torch.tensor([[0.0, 1.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]]), torch.zeros(1).long())
    scene, draws = field.scene(bodies, conditions), Draws.deterministic(1, 32, torch.device("cpu"))
    assert field.coverage(field.sample(scene, ray, draws)[0]).item() > 0.99

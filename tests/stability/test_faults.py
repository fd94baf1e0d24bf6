"""A0: faults of other projects' code, which ours doesn't have and an emulation shows."""

import contextlib
import functools
import math
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
import yaml
from torch import nn

from tests.helpers import splatting_scenes
from tests.helpers.splatting_scenes import NO_CUTOFFS, one_gaussian, random_cloud, rasterize
from tests.stability import scenes
from tests.stability.backends import backends_of
from tests.stability.report import row
from tests.stability.scenes import ball, drawn, joined, plain_image, seeded, stack, started
from threestudio_gaussiandreamer import cameras as host_cameras
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.streams import generator
from threestudio_gaussiandreamer.diffusion import sds
from threestudio_gaussiandreamer.gaussians import densify
from threestudio_gaussiandreamer.gaussians.grow import grow, nearest_distance_scales
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.guidance.base import NonFiniteScore
from threestudio_gaussiandreamer.splatting import torch_backend
from threestudio_gaussiandreamer.splatting.projection import quats_to_rotations
from threestudio_gaussiandreamer.training import geometry as clouds
from threestudio_gaussiandreamer.training.density import DensifyConfig, DensityControl
from threestudio_gaussiandreamer.training.geometry import LEARNING_RATES, GaussianCloud
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem

CONFIGS = Path(__file__).parents[2] / "configs"


def central_difference(f, x: float, step: float = 1e-5) -> float:
    above, below = (f(torch.tensor(x + h, dtype=torch.float64)) for h in (step, -step))
    return (above - below).item() / (2 * step)


def slope_of(f, x: float) -> float:
    """Return autograd's derivative of ``f`` at ``x``."""
    leaf = torch.tensor(x, dtype=torch.float64).requires_grad_()
    return torch.autograd.grad(f(leaf), leaf)[0].item()


def slope_error(f, x: float, truth) -> float:
    """Return the relative error of ``f``'s derivative against ``truth``'s finite difference."""
    expected = central_difference(truth, x)
    return abs(slope_of(f, x) - expected) / abs(expected)


@row("A0", "F1")
def test_f1_the_clamp_of_the_jacobian_depends_on_depth(backend, fault):
    """The emulation treats the clamped x = lim z as a constant, without its derivative by z."""
    scales = (1.5, 0.8, 0.4)

    def mean(z):
        return torch.stack([0 * z + 3.2, 0 * z + 0.1, z])

    def by_hand(z, slope=scenes.clamped_slope):
        spread = torch.tensor(scales).double()
        return scenes.clamped_alpha(mean(z), spread, 32, 20.0, 0.7, slope).sum()

    def constant_x(x, z, limit):
        clamped = (torch.clamp(x / z, -limit, limit) * z).detach()
        return torch.where((x / z).abs() < limit, x, clamped) / z

    def ours(z):
        cloud = one_gaussian(scale=scales, opacity=0.7)._replace(means=mean(z)[None])
        return drawn(backend, cloud, 32, 32, 20.0, **NO_CUTOFFS).alpha.double().sum()

    emulation = functools.partial(by_hand, slope=constant_x)
    fault(lambda f: slope_error(f, 2.0, by_hand), ours, emulation, 1e-4, "relative")


@row("A0", "F2")
def test_f2_no_gaussians_show_the_background(backend, fault):
    background = torch.tensor([0.2, 0.5, 0.9])

    def ours(cloud):
        leaves = cloud.to(torch.float32).leaves()
        image = drawn(backend, leaves, 8, 6, 8.0, background=background).image
        image.sum().backward()
        assert all(leaf.grad.shape == leaf.shape for leaf in leaves)
        return image

    black = torch.zeros(1, 6, 8, 3)
    fault(lambda image: (image - background).abs().max(), ours(random_cloud(0)), black)


@row("A0", "F3")
def test_f3_no_gradient_flows_through_the_cap(backend, fault):
    """An increase changes nothing; the emulation caps the value but passes the gradient."""

    def ours(opacity):
        cloud = one_gaussian(scale=5.0)._replace(opacities=opacity[None])
        return drawn(backend, cloud, 2, 2, 4.0, alpha_max=0.5).alpha.double().sum()

    def through_the_cap(opacity):
        alpha = opacity * torch.ones(2, 2)
        return (alpha + (alpha.clamp(max=0.5) - alpha).detach()).sum()

    both = ours, through_the_cap
    errors = (slope_of(f, 0.95) - central_difference(f, 0.95, 1e-3) for f in both)
    fault(abs, *errors, 1e-3)


@row("A0", "F4")
def test_f4_the_gaussian_that_crosses_the_stop_counts(backend, fault):
    opacities = [0.9, 0.905, 0.99]

    def stops_before(opacities):
        T = 1.0
        for alpha in opacities:
            if T * (1 - alpha) < 1e-4:
                break
            T *= 1 - alpha
        return 1 - T

    everything = 1 - np.prod(1 - np.array(opacities))
    ours = drawn(backend, stack(opacities, scale=10.0), 1, 1, 1.0).alpha.item()
    theirs = stops_before(opacities)
    fault(lambda alpha: abs(alpha - everything), ours, theirs, 1e-4, "of alpha")


@row("A0", "F5")
@pytest.mark.parametrize("backend", backends_of("reference"))
def test_f5_the_threshold_of_alpha(backend, fault):
    """A sphere like an initial cloud; the emulation uses the common threshold of 1/255."""
    means = torch.nn.functional.normalize(torch.randn(4000, 3, generator=seeded()), dim=1)
    cloud = random_cloud(4000, seed=1)._replace(
        means=means, scales=torch.full((4000, 3), 0.03), opacities=torch.full((4000,), 0.1)
    )
    camera = splatting_scenes.cameras(1, 64, 64, dtype=torch.float32)
    scene = *cloud.to(torch.float32), *camera, 64, 64

    def ours(**options):
        with torch.no_grad():
            return rasterize(*scene, **{"backend": backend, **options}).image

    truth = ours(**NO_CUTOFFS, backend="torch")
    common = functools.partial(ours, alpha_min=1 / 255)
    fault(lambda f: splatting_scenes.psnr(f(), truth), ours, common, at_least=55, unit="dB")


@row("A0", "F6")
@pytest.mark.parametrize(
    "attribute, value", [("means", math.nan), ("scales", math.inf), ("opacities", math.nan)]
)
def test_f6_what_is_not_finite_is_culled(backend, attribute, value, fault):
    """The emulation culls by two comparisons that are false for NaN."""
    scene = random_cloud(6, seed=2)
    scene.means[:, 2] += 3
    corrupted = scene.pick([*range(6), 0])
    getattr(corrupted, attribute)[6] = value

    def numbers(image, leaves):
        image.square().sum().backward()
        return [image.detach(), *(leaf.grad[:6] for leaf in leaves if leaf.grad is not None)]

    def ours(cloud):
        leaves = cloud.to(torch.float32).leaves()
        return numbers(drawn(backend, leaves, 10, 8, 8.0).image, leaves)

    def comparisons_that_nan_passes(cloud):
        leaves = cloud.leaves()
        z, det = leaves.means[:, 2], leaves.scales[:, 0] ** 2
        order = z.detach().argsort(stable=True)
        return numbers(plain_image(leaves, 10, 8, 8.0, ~(z <= 0.2) & ~(det == 0), order), leaves)

    def changed(draw):
        return sum(float((a != b).sum()) for a, b in zip(draw(corrupted), draw(scene), strict=True))

    fault(changed, ours, comparisons_that_nan_passes, unit="numbers changed")


@row("A0", "F7")
def test_f7_a_zero_quaternion_is_no_rotation(fault):
    def divided_by_the_norm(q):
        w, x, y, z = (q * q.square().sum(-1, keepdim=True).rsqrt()).unbind(-1)
        sums = y * y + z * z, x * x + z * z, x * x + y * y
        return torch.diag_embed(1 - 2 * torch.stack(sums, -1))

    def deviation(rotation):
        quats = torch.tensor([[0.0, 0, 0, 0], [1e-30, 0, 0, 0]], requires_grad=True)
        matrices = rotation(quats)
        matrices.sum().backward()
        good = (matrices.detach() == torch.eye(3)).all(-1).all(-1) & (quats.grad == 0).all(-1)
        return (~good).sum()

    fault(deviation, quats_to_rotations, divided_by_the_norm, unit="of 2 wrong")


@row("A0", "F8")
def test_f8_tile_intersections_are_counted_in_64_bits(fault):
    """524 288 Gaussians over all of 1024 x 1024 give 2^31 intersections with 16-pixel tiles."""
    n = 524_288

    def ours(side):
        rectangles = torch.tensor([[0], [0], [side], [side]]).expand(4, n)
        bounds = torch_backend.Bounds(torch.empty(6, 0), rectangles, torch.zeros(n).long())
        return sum((last - first) * side * side for first, last in torch_backend.slices(bounds))

    def in_32_bits(side):
        with np.errstate(over="ignore"):
            return int(np.full(n, side * side, np.int32).cumsum(dtype=np.int32)[-1])

    fault(lambda count: abs(count(64) / (n * 64 * 64) - 1), ours, in_32_bits, unit="relative")


@row("A0", "F9")
@pytest.mark.parametrize("n", [1, 2, 3])
def test_f9_first_scales_of_very_few_points(n, fault):
    points = np.eye(3, dtype=np.float32)[:n]

    def of_the_largest_float(points):
        distances = ((points[:, None] - points) ** 2).sum(-1) + np.diag([np.inf] * n)
        best = np.full((n, 3), np.finfo(np.float32).max, np.float32)
        best[:, : n - 1] = np.sort(distances)[:, : n - 1]
        with np.errstate(over="ignore"):
            return np.sqrt(best.sum(1, dtype=np.float32) / 3)

    def deviation(scales_of):
        log_scales = np.log(scales_of(points))
        return (~(np.isfinite(log_scales) & (np.abs(log_scales) < 20))).sum()

    fault(deviation, nearest_distance_scales, of_the_largest_float, unit="infinite scales")


@row("A0", "F10")
def test_f10_depth_has_a_gradient(backend, fault):
    """The emulation's backward pass ignores the rendered depth."""

    def at(z):
        return one_gaussian(scale=0.2)._replace(means=torch.stack([0 * z, 0 * z, z])[None])

    def ours(z):
        return drawn(backend, at(z), 8, 8, 8.0, **NO_CUTOFFS).depth.double().sum()

    def truth(z):
        camera = *splatting_scenes.front_camera(8, 8, 8.0), 8, 8
        return rasterize(*at(z), *camera, backend="reference", **NO_CUTOFFS).depth.sum()

    both = ours, lambda z: truth(z).detach() + 0 * z
    fault(float, *(slope_error(f, 2.0, truth) for f in both), 1e-4, "relative")


@row("A0", "F11")
def test_f11_the_loss_scale_does_not_affect_the_selection(fault):
    """Half of the gradients are above the threshold; mixed precision multiplies all of them."""
    true = torch.randn(2, 1000, 2, generator=seeded()) * (2e-4 / 64)

    def deviation(gradients):
        selected = [gradients(true * scale, 128, 128, scale) > 2e-4 for scale in (1.0, 65536.0)]
        return (selected[0] != selected[1]).float().mean() * 100

    ours, unit = densify.screen_gradients, "% selected differently"
    fault(deviation, ours, lambda *given: ours(*given[:3]), unit=unit)


@row("A0", "F12")
def test_f12_a_checkpoint_holds_the_cloud_and_its_statistics(fault):
    """The emulation keeps the cloud in a plain object. Ours doesn't run the prior on loading."""
    names = (*densify.PARAMETERS, *clouds.STATISTICS)

    def plain(source=None):
        module = nn.Module()
        module.cloud = SimpleNamespace(**{n: getattr(source, n, torch.zeros(0)) for n in names})
        return module

    def trained():
        geometry = started()
        geometry.gradient_sum += 1
        geometry.contribution += torch.rand(300, generator=seeded())
        return geometry

    def deviation(pair):
        saved, fresh = pair
        fresh.load_state_dict(saved.state_dict())
        one, other = (getattr(module, "cloud", module) for module in (saved, fresh))
        return sum(not torch.equal(getattr(one, name), getattr(other, name)) for name in names)

    ours = trained(), GaussianCloud({"prior_type": "a-prior-that-does-not-exist"})
    fault(deviation, ours, (plain(trained()), plain()), unit="tensors lost")


def left_of(geometry, contribution, most=500_000):
    """Return what densifies and prunes a cloud without limits leaves of it."""
    rules = DensifyConfig(min_opacity=0.0, max_scale=1e9)
    rest = contribution, rules, 1, most, generator(0, "s")
    parameters = geometry.parameters_by_name()
    return densify.densify_and_prune(parameters, torch.zeros(len(geometry)), *rest)


@row("A0", "F13")
def test_f13_one_gaussian_keeps_its_shape(fault):
    """The emulation squeezes the (1, 1) mask to a scalar, which adds a dimension."""
    geometry = started(1)
    ours = left_of(geometry, torch.ones(1)).values["means"]
    squeezed = geometry.means[(geometry.opacities()[:, None] >= 0).squeeze()]
    fault(lambda means: float(means.shape != (1, 3)), ours, squeezed, unit="wrong shapes")


def grown(points, **options):
    """Return how many points grow around uncoloured ones."""
    cloud = PointCloud(points, np.zeros_like(points))
    return len(grow(cloud, generator=np.random.default_rng(0), **options).points) - len(points)


def brute_force(points, radius, count=2000):
    """Return the candidates in the bounding box that are near a point, of an absolute radius."""
    candidates = np.random.default_rng(0).uniform(points.min(0), points.max(0), (count, 3))
    return [c for c in candidates if np.linalg.norm(points - c, axis=1).min() < radius]


@row("A0", "F14")
def test_f14_without_grown_points_the_input_is_returned(fault):
    """A cube of side 2 has eight corners; none of 100 candidates is near one."""
    corners = np.float32([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])

    def appended_to_a_list(points, num_candidates):
        return len(np.concatenate((points, np.array(brute_force(points, 0.01, num_candidates)))))

    both = grown, appended_to_a_list
    fault(lambda count: count(corners, num_candidates=100), *both, raises=ValueError)


@row("A0", "F15")
def test_f15_growth_does_not_depend_on_the_unit(fault):
    """Metres, millimetres, kilometres: the fraction of accepted candidates."""

    def deviation(accepted):
        counts = np.array([accepted(ball().points * unit) for unit in (1e-3, 1.0, 1e3)])
        return np.ptp(counts) / counts.mean()

    ours = functools.partial(grown, num_candidates=20_000, radius=0.05)
    fault(deviation, ours, lambda points: len(brute_force(points, 0.05)), 0.01, "relative")
    flat = ball().points * np.float32([1, 1, 0])  # every candidate in its box is near it
    options = {"enabled": True, "num_candidates": 20_000, "radius": 0.9, "max_points": 500}
    growing = GaussianCloud({"grow": options}).cfg.grow
    assert len(clouds.grow_points(PointCloud(flat, np.zeros_like(flat)), growing).points) <= 800


@row("A0", "F16")
def test_f16_growing_leaves_the_process_generators_alone(fault):
    def reseeding(points, **_):
        np.random.seed(0)
        np.random.uniform(-1, 1, (1000, 3))

    def deviation(grow_from):
        np.random.seed(7)
        expected, torch_state = np.random.RandomState(7).random(), torch.get_rng_state()
        grow_from(ball().points, num_candidates=1000)
        moved = not torch.equal(torch.get_rng_state(), torch_state)
        return float(np.random.random() != expected) + moved

    fault(deviation, grown, reseeding, unit="generators moved")


@row("A0", "F17")
def test_f17_a_sphere_is_round_on_a_wide_image(backend, fault):
    """The emulation uses the vertical field of view for the width."""
    fovy = torch.tensor([math.radians(50.0)])

    def one_angle_for_both(fovy, height, width):
        Ks = host_cameras.intrinsics(fovy, height, width)
        Ks[:, 0, 0] = 0.5 * width / torch.tan(0.5 * fovy)
        return Ks

    def deviation(intrinsics):
        scene = *one_gaussian(scale=0.2).to(torch.float32), torch.eye(4)[None]
        Ks = intrinsics(fovy, 64, 128)
        alpha = rasterize(*scene, Ks, 128, 64, backend=backend).alpha[0, ..., 0]
        across, down = ((alpha.sum(axis) > 0).sum() for axis in (0, 1))
        return abs(across - down).item() / 2

    fault(deviation, host_cameras.intrinsics, one_angle_for_both, 0.5, "px")


@row("A0", "F18")
def test_f18_densification_loses_no_step(fault):
    """The emulation replaces the rows between backward and step."""
    limits = dict(min_opacity=1e-9, grad_threshold=1e9, max_scale=1e9)
    none_selected = dict(enabled=True, start=1, stop=9, every=2, **limits)

    def step_first(geometry, optimizer, step):
        optimizer.step()
        DensityControl(geometry).after_step(optimizer, step)

    def densify_first(geometry, optimizer, step):
        if geometry.cfg.densify.enabled and step % 2 == 0:
            geometry.apply_change(DensityControl(geometry).densified(step), optimizer)
        optimizer.step()

    def trajectory(finish, **options):
        geometry = started(**options)
        groups = [{**group, "lr": 1e-2} for group in geometry.parameter_groups()]
        optimizer = torch.optim.Adam(groups)
        for step in range(1, 7):
            sum((p**2).sum() for p in geometry.parameters()).backward()
            finish(geometry, optimizer, step)
            optimizer.zero_grad()
        return geometry.means.detach()

    plain = trajectory(step_first)
    both = (trajectory(f, densify=none_selected) for f in (step_first, densify_first))
    fault(lambda means: (means - plain).abs().max(), *both, unit="moved")


@row("A0", "F19")
def test_f19_a_negative_loss_is_back_propagated(fault):
    """A whole training step on a loss of -p^2, with all other parts stubbed."""

    def ours(parameter):
        optimizer, taken = MagicMock(param_groups=[{"params": [parameter]}]), []
        optimizer.step.side_effect = lambda: taken.append(parameter.grad)
        system = MagicMock(global_step=1, return_value={"rasterized": None, "opacity": None})
        system.optimizers.return_value = optimizer
        system.losses.return_value = {"x": -(parameter**2).sum()}
        system.manual_backward.side_effect = lambda loss: loss.backward()
        system.trainer.precision_plugin.scaler = None
        system.optimize = functools.partial(GaussianDreamerSystem.optimize, system)
        GaussianDreamerSystem.training_step(system, {"width": 1, "height": 1}, 0)
        return taken[0]

    def if_positive(parameter):
        loss = -(parameter**2).sum()
        return torch.autograd.grad(loss, parameter)[0] if loss > 0 else torch.zeros(2)

    def deviation(step):
        parameter = torch.tensor([2.0, 3.0], requires_grad=True)
        return (step(parameter) + 2 * parameter.detach()).abs().max()

    fault(deviation, ours, if_positive)


@row("A0", "F20")
def test_f20_every_learning_rate_in_the_config_reaches_the_optimiser(fault):
    """The emulation reads ``scaling_lr`` from a configuration that sets ``scale_lr``."""
    rates = {name: 0.25 + 0.5**i for i, name in enumerate(LEARNING_RATES.values())}
    geometry = started(sh_degree=1, **rates)
    optimizer = torch.optim.Adam(geometry.parameter_groups())
    geometry.set_learning_rates(optimizer, 0, 0)
    ours = {LEARNING_RATES[group["name"]]: group["lr"] for group in optimizer.param_groups}
    misspelt = {name: rates.get(name.replace("scales", "scaling"), 0.005) for name in rates}

    def unread(found):
        return sum(found.get(name) != rate for name, rate in rates.items())

    fault(unread, ours, misspelt, unit="keys that are never read")


@row("A0", "F21")
def test_f21_the_cap_takes_what_contributes_least(fault):
    contribution = torch.rand(500, generator=seeded(1))
    best = contribution.sort(descending=True).values[:200].sum()

    def deviation(kept):
        return 1e9 if len(kept) != 200 else (1 - contribution[kept].sum() / best) * 100

    ours = left_of(started(500), contribution, most=200).parents
    at_random = torch.randperm(500, generator=seeded())[:200]
    fault(deviation, ours, at_random, unit="% of the contribution lost")


@row("A0", "F22")
def test_f22_a_non_finite_score_is_reported(fault):
    """The first of three items is NaN in every step; counts steps of twenty without a message."""
    rgb = torch.rand(3, 4, 4, 3, generator=seeded())
    guidance, healthy = (scenes.CorruptedScore({"guidance_scale": 1.0}) for _ in range(2))
    guidance.corrupted = {step: {0: math.nan} for step in range(20)}

    def ours(step):
        broken, out = scenes.score_gradient(guidance, rgb, step)
        whole, _ = scenes.score_gradient(healthy, rgb, step)
        assert (broken[0] == 0).all() and torch.equal(broken[1:], whole[1:])
        return out["bad_items"] > 0

    def deviation(said):
        silent = 0
        with contextlib.suppress(NonFiniteScore):
            for step in range(20):
                silent += not said(step)
        assert step == 9 or silent  # the tenth ends it
        return silent

    fault(deviation, ours, lambda step: False, unit="steps without a message")


@row("A0", "F23")
@pytest.mark.parametrize("percents", [(0.02, 1.0), (1.0, 1.0), (0.0, 0.0)])
def test_f23_every_timestep_has_its_entry(percents, fault):
    """The emulation draws up to and including 1000 of 1000."""
    table = sds.sd_alphas_cumprod()

    steps = (sds.timesteps(50, *sds.step_range(*percents), seed=0, step=i) for i in range(20))
    ours = torch.cat(list(steps))

    def deviation(t):
        table[t]  # IndexError on a CPU, a device assert on a GPU
        return ((t < 1) | (t > 999)).sum()

    inclusive = torch.randint(int(1000 * percents[0]), 1001, (200_000,), generator=seeded())
    fault(deviation, ours, inclusive, raises=IndexError)
    with pytest.raises(UserError, match="min"):
        sds.step_range(0.98, 0.5)


@row("A0", "F24")
def test_f24_the_guidance_scale_is_in_the_usual_convention(fault):
    """s = 1 is no guidance; the emulation starts at the conditional score."""
    e_c, e_u = torch.randn(2, 4, 8, 8, generator=seeded())
    exact = {1.0: e_c, 100.0: e_u + 100 * (e_c - e_u)}

    def deviation(guided):
        pairs = [(guided(e_c, e_u, scale), true) for scale, true in exact.items()]
        return max((found - true).abs().max() / true.abs().max() for found, true in pairs)

    from_the_conditional = lambda e_c, e_u, scale: e_c + scale * (e_c - e_u)  # noqa: E731
    fault(deviation, sds.classifier_free, from_the_conditional, 1e-6, "relative")


@row("A0", "F25")
def test_f25_each_preset_has_its_own_values(fault):
    """Scales, rotations, positions; the released code's times the extent 4."""
    told = {"paper": (1e-3, 1e-2, 5e-5), "code": (5e-3, 1e-3, 2e-4)}
    files = {"paper": "gaussiandreamer.yaml", "code": "gaussiandreamer-official.yaml"}

    def rates(name):
        geometry = yaml.safe_load((CONFIGS / name).read_text())["system"]["geometry"]
        means, *others = (geometry[f"lr_{key}"] for key in ("means", "scales", "quats"))
        return *others, means[1] if isinstance(means, list) else means

    def deviation(files):
        pairs = (zip(rates(files[who]), told[who], strict=True) for who in told)
        return sum(a != b for pair in pairs for a, b in pair)

    one_for_both = dict.fromkeys(files, files["code"])
    fault(deviation, files, one_for_both, unit="of 6 numbers wrong")


@row("A0", "F26")
def test_f26_nothing_behind_the_camera_and_equal_depths_by_index(backend, fault):
    behind = one_gaussian((0.0, 0.0, -2.0), 0.3, 0.9)
    colors = (1.0, 0, 0), (0, 1.0, 0)
    red_and_green = joined(*(one_gaussian((0.0, 0.0, 2.0), 0.3, 0.9, color) for color in colors))

    def unclipped_and_unstable(cloud):
        z = cloud.means[:, 2]
        backwards = torch.arange(len(z) - 1, -1, -1)  # an unstable sort may give this order
        order = backwards[z[backwards].argsort(stable=True)]
        return plain_image(cloud, 8, 8, 8.0, torch.ones(len(z), dtype=torch.bool), order)

    def deviation(draw):
        in_front = draw(red_and_green)[4, 4]
        return float((draw(behind) != 0).sum()) + float(in_front[0] < in_front[1])

    ours = lambda cloud: drawn(backend, cloud, 8, 8, 8.0).image[0]  # noqa: E731
    fault(deviation, ours, unclipped_and_unstable, unit="pixels or swaps")


@row("A0", "F27")
def test_f27_any_size_and_a_gaussian_behind_the_camera(backend, fault):
    """The emulation masks the means but not the covariances, and renders 256 x 256."""
    places = (0.0, 0.0, 2.0), (0.0, 0.0, -2.0), (0.3, 0.0, 3.0)
    scene = joined(*(one_gaussian(place, 0.3) for place in places))

    def half_masked(cloud):
        means, variances = cloud.means[cloud.means[:, 2] > 0], cloud.scales[:, 0] ** 2
        return (means[:, :2] / variances[:, None]).sum() * torch.ones(256, 256, 3)

    changed = lambda draw: (draw(scene) - draw(scene.pick([0, 2]))).abs().max()  # noqa: E731
    ours = lambda cloud: drawn(backend, cloud, 17, 9, 8.0).image[0]  # noqa: E731
    fault(changed, ours, half_masked, raises=RuntimeError)


@row("A0", "F27")
def test_f27_the_size_that_was_asked_for(backend, fault):
    """Widths from 1 to 40, none of which is 256; counts missing or extra columns."""

    def deviation(draw):
        sizes = [(1, 1), (40, 1), (17, 9), (31, 33)]
        return sum(draw(*s).shape != s[::-1] or bool((draw(*s) == 0).any()) for s in sizes)

    def ours(*size):
        return drawn(backend, one_gaussian(scale=5.0), *size, 8.0).alpha[0, ..., 0]

    fault(deviation, ours, lambda *size: torch.ones(256, 256), unit="of 4 sizes wrong")

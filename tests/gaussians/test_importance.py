"""Gradual pruning: exact counts, redundant Gaussians first."""

import math

import pytest
import torch

from threestudio_gaussiandreamer.cameras import orbit_c2w, to_opencv
from threestudio_gaussiandreamer.core.streams import generator
from threestudio_gaussiandreamer.gaussians import importance
from threestudio_gaussiandreamer.splatting import rasterize
from threestudio_gaussiandreamer.training.density import DensityControl
from threestudio_gaussiandreamer.training.geometry import GaussianCloud


def cloud(n, **options):
    geometry = GaussianCloud({"min_gaussians": 1, **options})
    rng = torch.Generator().manual_seed(0)
    geometry.set_arrays(
        means=torch.rand(n, 3, generator=rng) - 0.5,
        log_scales=torch.full((n, 3), -3.0),
        quats=torch.randn(n, 4, generator=rng),
        logit_opacities=torch.randn(n, generator=rng),
        sh=torch.rand(n, 1, 3, generator=rng),
    )
    geometry.contribution += torch.rand(n, generator=rng)
    return geometry


def rounds(geometry, steps):
    """Return the counts after each step of a schedule with a round at every step."""
    adam, counts = torch.optim.Adam(geometry.parameter_groups()), []
    control = DensityControl(geometry)
    for step in range(steps):
        geometry.gradient_sum += 1.0
        geometry.gradient_count += 1
        control.after_step(adam, step)
        counts.append(len(geometry))
        geometry.contribution += torch.rand(len(geometry))
    return counts


EVERY_STEP = {"start": 0, "stop": 100, "every": 1}
ONE_ROUND = {"start": 0, "stop": 1, "every": 1}
LATE = EVERY_STEP | {"start": 99}
GROWING = EVERY_STEP | {"enabled": True, "grad_threshold": 0.0, "min_opacity": 0.0}


@pytest.mark.parametrize(
    ("count", "options", "counts"),
    [
        (100, {"budget": 50, "prune": EVERY_STEP}, [80, 64, 51, 50, 50, 50]),
        (100, {"budget": 10, "prune": ONE_ROUND | {"stop": 3}}, [46, 21, 10, 10]),  # few rounds
        (100, {"prune": EVERY_STEP}, [100] * 3),
        (10, {"budget": 50, "prune": EVERY_STEP}, [10] * 3),
        # growth stays within what the budget leaves
        (100, {"budget": 50, "prune": EVERY_STEP, "densify": GROWING}, [80, 64, 51, 50, 50, 50]),
        (40, {"budget": 50, "prune": LATE, "densify": GROWING}, [50] * 3),
    ],
)
def test_the_budget_is_reached_round_by_round_and_then_holds(count, options, counts):
    assert rounds(cloud(count, **options), len(counts)) == counts


@pytest.mark.parametrize(
    ("given", "taken"), [("none", None), ("None", None), (5e3, 5000), ("Auto", "auto")]
)
def test_a_budget_may_have_a_unit(given, taken):
    assert GaussianCloud({"budget": given}).cfg.budget == taken


@pytest.mark.parametrize("sampled", [False, True])
def test_the_lowest_scores_are_pruned_first(sampled):
    geometry = cloud(100, budget=80, prune=EVERY_STEP)
    if sampled:
        geometry.removal += torch.rand(100, generator=torch.Generator().manual_seed(1))
    scores = geometry.removal.sqrt() * geometry.contribution if sampled else geometry.contribution
    best = scores.topk(80).indices.sort().values
    expected = geometry.means.detach()[best]
    assert rounds(geometry, 1) == [80] and torch.equal(geometry.means, expected)


def drawn(geometry, opacities):
    elevation, azimuth = torch.tensor([20.0, -10.0]), torch.tensor([30.0, 200.0])
    c2w = orbit_c2w(elevation, azimuth, torch.tensor([2.0, 2.0]))
    camera = to_opencv(c2w, torch.tensor([0.8, 0.8]), 32, 32)
    shape = geometry.means.double(), geometry.quats.double(), geometry.scales().double()
    colors, exact = geometry.colors(c2w[:, :3, 3]).double(), {"backend": "torch", "alpha_min": 0.0}
    return rasterize(*shape, opacities, colors, *camera, 32, 32, **exact).image


@pytest.mark.slow
def test_the_removal_error_is_that_of_leaving_each_gaussian_out():
    geometry = cloud(12)
    opacities = geometry.opacities().detach().double().requires_grad_()
    images = drawn(geometry, opacities)
    with torch.no_grad():
        without = [drawn(geometry, opacities * (torch.arange(12) != row)) for row in range(12)]
        exact = torch.stack([(image - images).square().sum() for image in without])
    drawing = (generator(0, "r", i) for i in range(3000))
    samples = torch.stack([importance.removal_error(images, opacities, rng) for rng in drawing])
    error = (samples.mean(0) - exact).abs() / (samples.std(0) / 3000**0.5 + 1e-12)
    assert exact.amin() > 1e-4 and error.amax() < 4  # standard errors
    assert (samples.mean(0) / exact - 1).abs().amax() < 0.15


def test_a_sample_of_the_removal_error_is_that_of_a_sum_of_signed_pixels():
    """The same to the bit, so that a run prunes as one of an earlier version did."""
    shape, opacities = (2, 5, 7, 3), torch.rand(4).requires_grad_()
    images, alpha = (torch.rand(*shape[:3], c, 4) @ opacities for c in (3, 1))
    color = torch.rand(2, 1, 1, 3) - 0.5
    signs = torch.randint(0, 2, shape, generator=generator(0, "r"), dtype=torch.float32) * 2 - 1
    total = (images * signs).sum() - (alpha * (signs * color).sum(-1, keepdim=True)).sum()
    (gradients,) = torch.autograd.grad(total, opacities, retain_graph=True)
    found = importance.removal_error(images, opacities, generator(0, "r"), (alpha, color))
    assert torch.equal(found, (opacities.detach() * gradients).square()) and found.amin() > 0
    added = alpha, color.expand(shape).clone()  # per pixel
    assert torch.equal(found, importance.removal_error(images, opacities, generator(0, "r"), added))


@pytest.mark.parametrize("backend", ["auto", "torch", "reference"])
def test_sampling_leaves_the_gradients_of_the_loss_alone(backend):
    """And Gaussians of the background's colour have a removal error too."""
    c2w = orbit_c2w(torch.tensor([20.0]), torch.tensor([30.0]), torch.tensor([2.0]))
    viewmats, Ks = to_opencv(c2w, torch.tensor([0.8]), 32, 32)
    left = []
    for budget in (None, 5):
        geometry = cloud(12, budget=budget, densify={"enabled": True, "absgrad": True})
        geometry.sh0.data[0] = -0.5 / 0.28209479177387814  # black, as the background
        opacities = geometry.opacities()
        shape = geometry.means, geometry.quats, geometry.scales()
        inputs = *shape, opacities, geometry.colors(c2w[:, :3, 3]), viewmats, Ks, 32, 32
        out = rasterize(*inputs, absgrad=True, backend=backend)
        pictures = {"comp_rgb": out.image, "opacity": out.alpha, "rasterized": out}
        pictures |= {"comp_rgb_bg": torch.zeros(1, 1, 1, 3), "gaussian_opacities": opacities}
        DensityControl(geometry).before_backward(pictures, 60)
        assert geometry.removal.any() == (budget is not None)
        assert budget is None or geometry.removal[0] > 0.01 * geometry.removal.median()
        (out.image**2).sum().backward()
        gradients = (p.grad for p in geometry.parameters() if p.numel())
        left.append([out.means2d.grad, out.means2d.absgrad, *gradients])
    assert all(torch.equal(plain, sampled) for plain, sampled in zip(*left, strict=True))


@pytest.mark.parametrize(("saved", "count"), [(0.0, 80), (0.5, 80), (0.95, 95), (1.5, 100)])
def test_a_round_of_auto_drops_fewer_the_more_it_costs(saved, count):
    """``saved``: the cost of a whole round, in units of that where rounds end."""
    removal, error = torch.ones(100), 7.0
    removal[:20] = (10 ** (0.1 * saved * importance.SLOPE * math.log2(100 / 80)) - 1) * error / 20
    need = importance.needed_count(torch.arange(100.0), removal, error, 0.5, 0.8)
    assert need.count == pytest.approx(count, abs=1)
    assert need.gain == pytest.approx(0.5 * saved**importance.POWER, rel=1e-3)


def test_auto_drops_idle_gaussians_and_samples_where_a_round_will_ask_for_them():
    """Those that save less than a hundredth of their part of the error."""
    removal = torch.ones(100)
    removal[:10] = 1e-4
    assert importance.needed_count(torch.arange(100.0), removal, 7.0, 0.5, 0.8).count == 90
    removal[:50] = 1e-4
    assert importance.needed_count(torch.arange(100.0), removal, 7.0, 0.5, 0.8).count == 80
    schedule = {"start": 100, "stop": 900, "every": 50}
    control = DensityControl(cloud(10, budget=5, prune=schedule))
    due = [step for step in (48, 51, 52, 848, 849, 852) if control.samples_removal(step)]
    assert due == [52, 848]


@pytest.mark.parametrize(("count", "keep"), [(1, 0.8), (2, 0.99), (3, 1e-6)])
def test_very_few_gaussians_never_become_none(count, keep):
    removal = torch.zeros(count)
    need = importance.needed_count(removal, removal, 1.0, 0.5, keep)
    assert 0 <= need.count <= count
    geometry = cloud(count, budget="auto", prune=ONE_ROUND | {"keep": keep})
    geometry.error.fill_(1.0)
    assert 1 <= rounds(geometry, 1)[0] <= count

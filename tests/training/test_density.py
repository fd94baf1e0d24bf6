"""The outcome of a round of density control."""

import math

import pytest
import torch

from threestudio_gaussiandreamer.training.density import DECAY, DensityControl
from threestudio_gaussiandreamer.training.geometry import GaussianCloud

EACH_STEP = {"start": 0, "stop": 10, "every": 1}
ROUNDS = {"enabled": True, "start": 1, "stop": 12, "every": 5}
"""Of densification, at 5 and 10."""


def control(count=10, **options):
    cloud = GaussianCloud({"min_gaussians": 1, "prune": EACH_STEP, **options})
    cloud.set_arrays(
        means=torch.zeros(count, 3),
        log_scales=torch.zeros(count, 3),
        quats=torch.ones(count, 4),
        logit_opacities=torch.zeros(count),
        sh=torch.zeros(count, 1, 3),
    )
    cloud.contribution.copy_(torch.linspace(0.1, 0.4, count))
    return DensityControl(cloud)


def after_step(density, step=0):
    return density.after_step(torch.optim.Adam(density.cloud.parameter_groups()), step)


def test_a_round_says_how_many_it_left_and_opacities_decay_between_those_of_auto():
    density = control(budget=None)
    means = density.cloud.means
    assert after_step(density) is None and density.cloud.means is means
    density = control(budget=5)
    density.cloud.started_with.fill_(1200)
    assert after_step(density) is None and len(density.cloud) == 8
    assert density.summary() == "8 of 1,200 Gaussians: the budget is 5"
    assert control().summary() == "10 Gaussians: no budget"  # of a checkpoint without the number
    for budget, step, decays in (("auto", 5, True), ("auto", 10, False), (5, 5, False)):
        density = control(budget=budget, lr_opacities=0.02)
        adam = torch.optim.Adam(density.cloud.parameter_groups())
        density.cloud.set_learning_rates(adam, 0, 0)
        before = density.cloud.logit_opacities.detach().clone()
        density.cloud.cfg.prune.keep = 0.999  # nothing is dropped
        density.after_step(adam, step)
        fallen = before[: len(density.cloud)] - density.cloud.logit_opacities.detach()
        rate = 0.02 if decays else 0.0
        assert torch.allclose(fallen, torch.full_like(fallen, DECAY * rate))


def sampled(density, removal, error):
    density.cloud.removal.copy_(removal)
    density.cloud.error.fill_(error)
    return density


def test_a_round_of_auto_says_what_more_would_gain_and_so_does_the_end():
    """Those that a round drops save a fortieth of the error: at this cost it keeps all."""
    density = sampled(control(budget="auto"), torch.full((10,), 0.0125), 1.0)
    density.cloud.started_with.fill_(10)
    assert density.summary() == "10 of 10 Gaussians: no round has dropped any"
    needed = after_step(density)
    cost = 10 * math.log10(1.025) / math.log2(10 / 8)
    assert needed.gain == pytest.approx(0.5 * (cost / 0.12) ** 2) and len(density.cloud) == 10
    assert str(needed) == "half as many would lose 1 dB or more"
    assert density.summary() == "10 of 10 Gaussians: a round would have lost too much"
    density.cloud.gain.fill_(0.25)
    after_step(sampled(density, torch.full((10,), 0.0125), 1.0))
    assert density.summary() == "10 of 10 Gaussians: twice as many would gain 0.2 dB"
    after_step(sampled(density, torch.zeros(10), 0.0))  # a round without a sample
    assert density.summary() == "10 of 10 Gaussians: twice as many would gain 0.2 dB"


@pytest.mark.parametrize("error", [0.0, math.nan, math.inf])
def test_auto_drops_nothing_without_a_sample_or_with_nan_among_the_views(error):
    density = sampled(control(budget="auto"), torch.zeros(10), error)
    after_step(density)
    assert len(density.cloud) == 10


@pytest.mark.parametrize("known", [True, False])
def test_the_error_of_a_round_is_that_of_its_views_or_of_the_likeness(known):
    """A known error below that of 36 dB counts as that."""
    density = control(budget="auto", prune={**EACH_STEP, "likeness": 20.0})
    image = torch.rand(2, 4, 4, 3, requires_grad=True)
    opacities = density.cloud.opacities()
    pictures = {
        "comp_rgb": image * opacities.mean(),
        "opacity": image[..., :1] * opacities.mean(),
        "comp_rgb_bg": torch.zeros(2, 1, 1, 3),
        "gaussian_opacities": opacities,
    }
    for error, expected in ((0.25, 0.25 if known else 0.01), (1e-6, 2.5e-4 if known else 0.01)):
        density.cloud.error.zero_()
        mean = (lambda error=error: torch.tensor(error)) if known else None
        density.before_backward(pictures, 3, mean)
        assert float(density.cloud.error) == pytest.approx(expected * 2 * 4 * 4 * 3)
    assert density.cloud.removal.amin() > 0


@pytest.mark.parametrize(
    "options, step, end, said",
    [
        ({"budget": None}, 0, 5, None),
        ({"budget": 5}, 0, 5, "4 of the 10 rounds of pruning would come after step 5"),
        ({"budget": 5}, 0, -1, None),
        ({"budget": 5}, 9, 10, "0 rounds of pruning must reduce 10 Gaussians to 5; use more"),
        ({"budget": 2}, 0, 10, None),
        ({"budget": 1}, 7, 10, "2 rounds of pruning must reduce 10 Gaussians to 1"),
        ({"budget": 20}, 9, 10, None),
        ({"budget": "auto"}, 0, 10, "too rarely in 1 steps a round"),
        ({"budget": "auto", "prune": {"start": 1, "stop": 9, "every": 20}}, 0, 20, "no round"),
        ({"budget": "auto", "prune": {"start": 20, "stop": 50, "every": 12}}, 0, 50, None),
        ({"densify": ROUNDS}, 0, 20, None),
        ({"densify": ROUNDS}, 10, -1, None),
        ({"densify": ROUNDS}, 0, 5, "1 of the 2 rounds of densification would come after step 5"),
        ({"densify": ROUNDS | {"every": 50}}, 0, 20, "densification has no round"),
        ({"densify": ROUNDS, "max_gaussians": 10}, 0, 20, "10 Gaussians leave no room for more"),
        ({"max_gaussians": 5}, 3, 100, "10 Gaussians leave no room"),  # of a checkpoint
        ({"max_gaussians": 10}, 3, 100, None),
        ({"densify": ROUNDS, "max_gaussians": 10}, 12, 20, None),
        ({"budget": 5, "densify": ROUNDS}, 0, 5, "set system.geometry.prune.start"),
    ],
)
def test_a_schedule_that_cannot_do_what_it_is_to_is_described(options, step, end, said):
    problem = control(**options).schedule_problem(step, end)
    assert problem is None if said is None else said in problem

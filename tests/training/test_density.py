"""The outcome of a round of density control. Which rounds take place: ``test_geometry.py``,
``tests/gaussians/test_importance.py`` and ``tests/stability/test_densification.py``.
"""

import pytest
import torch

from threestudio_gaussiandreamer.training.density import (
    DensityControl,
    DensityOutcome,
    QualityResult,
    RenderedQuality,
    smallest_passing_count,
)
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


def after_step(density, step=0, check=None):
    return density.after_step(torch.optim.Adam(density.cloud.parameter_groups()), step, check)


def test_a_step_without_a_round_leaves_the_cloud():
    density = control(budget=None)
    means = density.cloud.means
    assert after_step(density) == DensityOutcome(10, 10, False, {}) and density.cloud.means is means


def test_a_cloud_larger_than_max_gaussians_is_reported():
    """That of a checkpoint; densification would reduce it."""
    said = control(10, max_gaussians=5, budget=None).schedule_problem(3, 100)
    assert "10 Gaussians, more than system.geometry.max_gaussians (5)" in said
    assert control(10, max_gaussians=10, budget=None).schedule_problem(3, 100) is None
    densified = control(10, max_gaussians=5, budget=None, densify=ROUNDS)
    assert "the checkpoint has" not in densified.schedule_problem(3, 100)
    assert "the checkpoint has" in densified.schedule_problem(11, 100)


def test_a_round_says_how_many_it_left():
    assert after_step(control(budget=5)) == DensityOutcome(10, 8, True, {})


def test_a_round_of_auto_says_what_the_accepted_count_cost():
    """Not the loss of the last count that was tried."""

    def check(kept):
        count = int(kept.sum())
        return QualityResult(torch.tensor(count - 94.5), {"prune/lost": float(100 - count)})

    density = control(100, budget="auto", prune={**EACH_STEP, "stop": 2})
    outcome = after_step(density, 1, check)
    assert 95 <= outcome.after <= 96 and outcome.measured == {"prune/lost": 100.0 - outcome.after}


@pytest.mark.parametrize("margin", [-1.0, float("nan")])
def test_quality_that_is_lost_or_unknown_never_holds(margin):
    result = QualityResult(torch.tensor(margin), {"prune/lost": 1.0})
    assert smallest_passing_count(torch.arange(10.0), 5, lambda kept: result) == (10, {})


@pytest.mark.parametrize("known", [True, False])
def test_quality_is_measured_against_the_truth_or_between_renders(known):
    """All Gaussians are rendered once for all counts that a round tries."""
    density = control(budget="auto", prune={**EACH_STEP, "quality": 4.0, "likeness": 19.0})
    rendered = []

    def render():
        missing = float((density.cloud.logit_opacities == -100).sum())
        rendered.append(missing)
        return {"comp_rgb": torch.full((1, 4, 4, 3), 0.01 + 0.01 * missing)}

    truth = torch.zeros(1, 4, 4, 3) if known else None
    check = RenderedQuality(density, render, lambda whole: truth)
    kept = torch.arange(10) != 3
    for _ in range(2):
        result = check(kept)
    assert rendered == [0.0, 1.0, 1.0]
    lost, similarity = 10 * torch.tensor(4.0).log10(), torch.tensor(40.0)
    affordable = 4.0 / len(density.prune_rounds)
    expected = affordable - lost if known else similarity - 19.0
    assert torch.allclose(result.margin, expected, atol=1e-4)
    names = ("lost", "affordable") if known else ("likeness", "asked_for")
    assert set(result.measured) == {f"prune/{name}" for name in names}


@pytest.mark.parametrize(
    "options, step, end, said",
    [
        ({"budget": None}, 0, 5, None),
        ({"budget": 5}, 0, 5, "4 of the 10 rounds of pruning would come after step 5"),
        ({"budget": 5}, 0, -1, None),
        (
            {"budget": 5},
            9,
            10,
            "no round of pruning remains, so 10 Gaussians are kept instead of 5",
        ),
        ({"budget": 2}, 0, 10, None),
        ({"budget": 1}, 7, 10, "2 rounds of pruning must reduce 10 Gaussians to 1"),
        ({"budget": 20}, 9, 10, None),
        ({"densify": ROUNDS}, 0, 20, None),
        ({"densify": ROUNDS}, 10, -1, None),
        ({"densify": ROUNDS}, 0, 5, "1 of the 2 rounds of densification would come after step 5"),
        ({"densify": ROUNDS | {"every": 50}}, 0, 20, "densification has no round"),
        ({"densify": ROUNDS, "max_gaussians": 10}, 0, 20, "there are 10 Gaussians, the most"),
        ({"densify": ROUNDS, "max_gaussians": 10}, 12, 20, None),
        ({"budget": 5, "densify": ROUNDS}, 0, 5, "set system.geometry.prune.start"),
    ],
)
def test_a_schedule_that_cannot_do_what_it_is_to_is_described(options, step, end, said):
    problem = control(**options).schedule_problem(step, end)
    assert problem is None if said is None else said in problem

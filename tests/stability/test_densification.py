"""A3: densification and pruning that explode or collapse, with the package's renderer and
geometry.
"""

import math

import pytest
import torch
from scipy.spatial import cKDTree

from tests.stability.densification_cases import EVERY_STEP, NO_LIMITS, Training, started
from tests.stability.rows import row
from tests.stability.small_runs import launch
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.streams import generator
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.gaussians import densify
from threestudio_gaussiandreamer.gaussians.densify import PARAMETERS, Rules, Statistics
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.gaussians.simplify import view_importance
from threestudio_gaussiandreamer.gaussians.views import render_all, views_around
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.training.density import DensityControl
from threestudio_gaussiandreamer.training.geometry import STATISTICS, GaussianCloud

register_parts()


def drawn(geometry: GaussianCloud) -> Gaussians:
    return Gaussians.of(geometry).map(torch.Tensor.detach)


# ---- too many ------------------------------------------------------------------------------------


@row("A3", "Explosion")
@pytest.mark.parametrize("limit", ["max_gaussians", "budget"])
@pytest.mark.parametrize("absgrad", [False, True], ids=["gradient", "absgrad"])
def test_threshold_zero_fills_the_cap_and_no_more(limit, absgrad, measured):
    """Every visible Gaussian is selected at every step: 200, 400, then 500 from then on."""
    growing = EVERY_STEP | NO_LIMITS | {"grad_threshold": 0.0, "absgrad": absgrad}
    geometry = started(
        **{limit: 500}, densify=growing, prune={"start": 0, "stop": 10_000, "every": 1}
    )
    counts = Training(geometry).run(12)
    measured(max(counts), "Gaussians, cap 500", at_most=500)
    measured(min(counts[2:]), "Gaussians, once it is full", at_least=500)


@row("A3", "Explosion")
@pytest.mark.parametrize("cap", [64, 123, 199])
def test_above_the_cap_the_smallest_contributions_are_removed_first(cap, measured):
    """A cloud larger than the cap, ranked by the contributions of one step; no Gaussian is
    selected.
    """
    geometry = started(max_gaussians=cap, densify=EVERY_STEP | NO_LIMITS | {"grad_threshold": 1e9})
    training = Training(geometry)
    training.observe(slice(None))
    best = geometry.contribution.topk(cap).indices.sort().values
    expected = geometry.means.detach()[best]
    DensityControl(geometry).after_step(training.optimizer, 1)
    assert torch.equal(geometry.means, expected)
    measured(abs(len(geometry) - cap), "off the cap", at_most=0)


@row("A3", "Explosion")
def test_a_trained_cloud_that_is_too_large_keeps_what_contributes(tmp_path, measured, said):
    """Half of 400 trained Gaussians are hidden or faint; a random choice would keep as many of them
    as of the others.
    """
    trained = started(400)
    trained.means.data[::2] *= torch.linspace(0.1, 0.9, 200)[:, None]
    trained.logit_opacities.data = (
        torch.randn(400, generator=generator(0, "o")) * 2 + torch.arange(400) % 2 * 2
    )
    write_cloud(str(tmp_path / "a.ply"), StoredCloud(drawn(trained).arrays()))
    geometry = GaussianCloud(
        {
            "prior_type": "gaussians-prior",
            "prior": {"path": str(tmp_path / "a.ply")},
            "max_gaussians": 150,
        }
    )
    geometry.initialize("a prompt")
    assert len(geometry) == 150 and any(
        "has 400 Gaussians; keeping the 150" in message for message in said
    )
    views = views_around(drawn(trained), 4, 64, turn=30)

    def psnr_to_trained(cloud: Gaussians) -> float:
        return psnr(render_all(cloud, views), render_all(drawn(trained), views)).mean().item()

    lots = [torch.randperm(400, generator=generator(seed, "lottery"))[:150] for seed in range(5)]
    luckiest = max(psnr_to_trained(drawn(trained).rows(rows)) for rows in lots)
    measured(
        psnr_to_trained(drawn(geometry)) - luckiest,
        "dB better than the best of 5 random choices",
        at_least=2.0,
    )


@row("A3", "Explosion")
def test_a_first_cloud_that_is_too_large_is_thinned_evenly(measured, said):
    """Before training all Gaussians are equally opaque and equally important, and the outer ones
    hide the rest. Ranking by contribution leaves holes that growing must fill again; an even choice
    does not. Both choices, of 10 000 to 2500.
    """
    prior = {
        "prior_type": "mesh-prior",
        "prior": {"path": "toy.glb", "num_points": 8000, "color_smoothing": 40},
    }
    options = prior | {"grow": {"num_candidates": 400_000, "max_points": 2000}}
    whole, capped = GaussianCloud(options), GaussianCloud(options | {"max_gaussians": 2500})
    for geometry in (whole, capped):
        geometry.initialize("a prompt")
    assert len(capped) == 2500 and any(
        "give 10000 points; keeping 2500" in message for message in said
    )
    ranked = GaussianCloud(prior)
    rows = view_importance(drawn(whole), views_around(drawn(whole), 8, 128)).topk(2500).indices
    ranked.start_from(
        PointCloud(
            whole.means.detach()[rows].numpy(),
            whole.colors(torch.zeros(1, 3)).detach()[rows].numpy(),
        )
    )
    views = views_around(drawn(whole), 4, 96, turn=30)
    pictures = [render_all(drawn(geometry), views) for geometry in (whole, capped, ranked)]
    holes = [
        cKDTree(geometry.means.detach()).query(whole.means.detach())[0].max()
        for geometry in (capped, ranked)
    ]
    measured(holes[0] / holes[1], "of the largest hole when ranked", at_most=0.8)
    measured(
        psnr(pictures[1], pictures[0]).mean() - psnr(pictures[2], pictures[0]).mean(),
        "dB over the ranked",
        at_least=0.0,
    )


# ---- too few -------------------------------------------------------------------------------------


@row("A3", "Collapse to 0")
@pytest.mark.parametrize(
    "rules",
    [{"min_opacity": 1.1}, {"min_opacity": 0.05, "max_scale": 1e-6}],
    ids=["opacity", "extent"],
)
def test_the_floor_keeps_what_contributes_most(rules, measured, said):
    geometry = started()
    Training(geometry).observe(slice(None))
    stats = Statistics(geometry.gradient_sum, geometry.contribution)
    change = densify.densify_and_prune(
        geometry.parameters_by_name(), stats, Rules(grad_threshold=1e9, **rules), generator(0, "s")
    )
    assert torch.equal(change.parents, geometry.contribution.topk(64).indices.sort().values)
    assert said == [
        "only 0 of 200 Gaussians would be left: the 64 that contribute most stay (min_gaussians)"
    ]
    measured(len(change.parents), "left", at_least=64)


@row("A3", "Collapse to 0")
def test_no_opacity_can_exceed_one(measured):
    with pytest.raises(UserError, match="min_opacity"):
        GaussianCloud({"densify": {"min_opacity": 1.1}})
    measured("min_opacity 1.1 is refused")


@row("A3", "Collapse to 0")
@pytest.mark.parametrize("wrong", ["min_opacity=0.999", "max_scale=1e-6"])
def test_a_run_that_would_lose_all_ends_with_the_floor(wrong, tmp_path, measured, said):
    """Runs the command with rules that drop every Gaussian in each of three rounds."""
    rounds = [
        f"system.geometry.densify.{option}"
        for option in ("enabled=true", "start=1", "every=2", wrong)
    ]
    ended = launch(tmp_path, *rounds, "trainer.max_steps=6")
    assert (
        ended.code == 0
        and sum("contribute most stay (min_gaussians)" in message for message in said) == 3
    )
    measured(len(ended.checkpoint()["state_dict"]["geometry.means"]), "left, exit 0", at_least=64)


@row("A3", "N=1 squeeze")
@pytest.mark.parametrize("absgrad", [False, True], ids=["gradient", "absgrad"])
@pytest.mark.parametrize("n", [1, 2, 3])
def test_very_few_keep_their_shapes(n, absgrad, measured):
    """Clones, splits and prunes after training steps; the counts show that each happened."""
    for split_scale, expected in ((1e9, 2 * n), (1e-9, 2 * n)):
        rules = (
            EVERY_STEP
            | NO_LIMITS
            | {"grad_threshold": 0.0, "split_scale": split_scale, "absgrad": absgrad}
        )
        geometry = started(
            n,
            min_gaussians=1,
            densify=rules,
            prune={"start": 2, "stop": 100, "every": 2},
            budget=2 * n,
        )
        training = Training(geometry)
        assert training.run(1) == [expected]
        geometry.options.budget, geometry.options.densify.grad_threshold = 1, 1e9
        assert training.run(1) == [max(1, int(0.8 * expected))]
        shapes = geometry._shapes(len(geometry)) | {name: (len(geometry),) for name in STATISTICS}
        assert all(tuple(getattr(geometry, name).shape) == shape for name, shape in shapes.items())
    measured("clone, split and prune: (M, ...)")


@row("A3", "MCMC relocation with no live Gaussian / all-zero opacity")
@pytest.mark.parametrize("budget", [None, 100, "auto"])
@pytest.mark.parametrize("score", ["contribution", "opacity", "random"])
def test_a_transparent_cloud_shrinks_to_the_floor(budget, score, measured):
    """Nothing is relocated, so no distribution without mass is sampled: a transparent cloud shrinks
    to the floor and training continues.
    """
    prune = {"start": 1, "stop": 10_000, "every": 1, "score": score}
    geometry = started(
        budget=budget, prune=prune, densify=EVERY_STEP | {"start": 5, "grad_threshold": 0.0}
    )
    geometry.logit_opacities.data[:100], geometry.logit_opacities.data[100:] = -15.0, -math.inf
    training = Training(geometry)
    counts = training.run(8)
    assert (training.render(geometry, slice(None))["comp_rgb"] == 1).all()  # the background alone
    finite = all(
        getattr(geometry, name).isfinite().all() for name in PARAMETERS if name != "logit_opacities"
    )
    assert finite and counts == sorted(counts, reverse=True)
    measured(counts[-1], "left of 200 transparent ones", at_least=64)

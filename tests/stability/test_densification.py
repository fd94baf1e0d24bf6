"""A3: densifying and pruning that explodes, collapses, loses state or means something else; with
the product's renderer and geometry.
"""

import hashlib
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from tests.stability.rows import row
from tests.stability.small_runs import DEMO, Ended, differences, launch
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.cameras import orbit_c2w
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.streams import generator
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.gaussians import densify
from threestudio_gaussiandreamer.gaussians.densify import PARAMETERS, Rules, Statistics
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.gaussians.simplify import view_importance
from threestudio_gaussiandreamer.gaussians.views import render_all, views_around
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.training.density import DensityControl
from threestudio_gaussiandreamer.training.geometry import STATISTICS, GaussianCloud

register_parts()
NO_LIMITS = {"min_opacity": 0.0, "max_scale": 1e9}
EVERY_STEP = {"enabled": True, "start": 1, "stop": 10_000, "every": 1}


def ball(n: int = 200, seed: int = 0) -> PointCloud:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3))
    points *= 0.7 / np.linalg.norm(points, axis=1, keepdims=True)
    return PointCloud(points.astype(np.float32), rng.random((n, 3), np.float32))


def started(n: int = 200, seed: int = 0, **options) -> GaussianCloud:
    geometry = GaussianCloud({"grow": {"enabled": False}, "init_opacity": 0.5, **options})
    geometry.start_from(ball(n, seed))
    return geometry


class Training:
    """The system's step, in its order, with the product's parts: towards the pictures of another
    cloud, from four fixed cameras.
    """

    def __init__(self, geometry: GaussianCloud, size: int = 32) -> None:
        self.geometry, self.size, self.step = geometry, size, 0
        angles = torch.arange(4)
        self.c2w, self.fovy = (
            orbit_c2w(10.0 * angles, 90.0 * angles + 20, torch.full((4,), 2.5)),
            torch.full((4,), 0.8),
        )
        self.truth = self.render(started(150, seed=1, init_opacity=0.9), slice(None))[
            "comp_rgb"
        ].detach()
        self.optimizer = torch.optim.Adam(
            [{**group, "lr": 1e-2} for group in geometry.parameter_groups()],
            betas=(0.9, 0.99),
            eps=1e-15,
        )

    def render(self, geometry: GaussianCloud, views: slice) -> dict:
        behind = find("gaussiandreamer-background")({"mode": "fixed", "color": [1.0, 1.0, 1.0]})
        renderer = find("gaussiandreamer-splatting")(
            {}, geometry=geometry, material=None, background=behind
        )
        return renderer(self.c2w[views], self.fovy[views], self.size, self.size)

    def observe(self, views: slice, loss_scale: float = 1.0) -> None:
        """Render, go backwards, and let the geometry see it; the mean over the batch of each view's
        mean squared error.
        """
        out = self.render(self.geometry, views)
        loss = ((out["comp_rgb"] - self.truth[views]) ** 2).mean()
        (loss * loss_scale).backward()
        DensityControl(self.geometry).after_backward(
            out["rasterized"], self.size, self.size, loss_scale
        )

    def run(self, steps: int) -> list[int]:
        """The count after each step."""
        counts = []
        for _ in range(steps):
            self.observe(slice(None))
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
            self.step += 1
            DensityControl(self.geometry).after_step(self.optimizer, self.step)
            counts.append(len(self.geometry))
        return counts

    @torch.no_grad()
    def quality(self) -> float:
        return psnr(self.render(self.geometry, slice(None))["comp_rgb"], self.truth).mean().item()


def seen_alike(geometry: GaussianCloud, gradient: torch.Tensor, contribution: torch.Tensor) -> None:
    """Statistics as if one view had seen every Gaussian."""
    geometry.gradient_sum.copy_(gradient)
    geometry.gradient_count.fill_(1)
    geometry.contribution.copy_(contribution)


def drawn(geometry: GaussianCloud) -> Gaussians:
    return Gaussians.of(geometry).map(torch.Tensor.detach)


# ---- too many ------------------------------------------------------------------------------------


@row("A3", "Explosion")
@pytest.mark.parametrize("limit", ["max_gaussians", "budget"])
@pytest.mark.parametrize("absgrad", [False, True], ids=["gradient", "absgrad"])
def test_threshold_zero_fills_the_cap_and_no_more(limit, absgrad, measured):
    """Every Gaussian that was seen wants to grow at every step: 200, 400, then 500 for good."""
    growing = EVERY_STEP | NO_LIMITS | {"grad_threshold": 0.0, "absgrad": absgrad}
    geometry = started(
        **{limit: 500}, densify=growing, prune={"start": 0, "stop": 10_000, "every": 1}
    )
    counts = Training(geometry).run(12)
    measured(max(counts), "Gaussians, cap 500", at_most=500)
    measured(min(counts[2:]), "Gaussians, once it is full", at_least=500)


@row("A3", "Explosion")
@pytest.mark.parametrize("cap", [64, 123, 199])
def test_above_the_cap_what_contributes_least_goes_first(cap, measured):
    """A cloud that is larger than the cap, by contributions that the renders of one step gave;
    nobody wants to grow.
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
    """Half of 400 trained Gaussians are hidden or faint; a lottery would keep as many of them as of
    the others.
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
        "dB better than the best of 5 lotteries",
        at_least=2.0,
    )


@row("A3", "Explosion")
def test_a_first_cloud_that_is_too_large_is_thinned_evenly(measured, said):
    """A first cloud isn't trained: all are equally opaque, none is worth more than another, and
    what lies outside hides the rest.

    To rank by what each shows in its renders leaves holes that grow must fill again; an even choice
    doesn't. Both, of 10 000 to 2500."""
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
    """The whole command, with rules that drop every Gaussian in each of three rounds."""
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
    """Cloned, split and pruned after steps of training; the counts say that each happened."""
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
        geometry.cfg.budget, geometry.cfg.densify.grad_threshold = 1, 1e9
        assert training.run(1) == [max(1, int(0.8 * expected))]
        shapes = geometry._shapes(len(geometry)) | {name: (len(geometry),) for name in STATISTICS}
        assert all(tuple(getattr(geometry, name).shape) == shape for name, shape in shapes.items())
    measured("clone, split and prune: (M, ...)")


@row("A3", "MCMC relocation with no live Gaussian / all-zero opacity")
@pytest.mark.parametrize("budget", [None, 100, "auto"])
@pytest.mark.parametrize("score", ["contribution", "opacity", "random"])
def test_a_dead_cloud_is_survived(budget, score, measured):
    """Nothing is relocated, so nothing is drawn from a distribution without mass: a dead cloud
    shrinks to the floor and trains on.
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
    measured(counts[-1], "left of 200 dead ones", at_least=64)


# ---- state ---------------------------------------------------------------------------------------


class Ledger:
    """Gives every Gaussian an id, which its colour hides and the moments of all its parameters
    spell, and looks at what is left of it.
    """

    def __init__(self, geometry: GaussianCloud, optimizer: torch.optim.Optimizer) -> None:
        self.geometry, self.optimizer = geometry, optimizer

    def parameters(self) -> list[torch.nn.Parameter]:
        """Those with state; spherical harmonics above degree 0 may have no numbers."""
        return [
            parameter
            for parameter in self.geometry.parameters()
            if parameter.numel() and parameter in self.optimizer.state
        ]

    def write(self, ids: torch.Tensor) -> None:
        self.geometry.sh0.data[:] = ids[:, None, None]
        for parameter in self.parameters():
            self.optimizer.state[parameter] |= {
                "exp_avg": spelt(ids, parameter),
                "exp_avg_sq": 2 * spelt(ids, parameter),
            }

    def ids(self) -> torch.Tensor:
        return self.geometry.sh0[:, 0, 0].detach().clone()

    def fresh(self) -> torch.Tensor:
        """Which Gaussians have no past, the same by all their moments; every other has its own, bit
        for bit.
        """
        held = {
            id(parameter) for group in self.optimizer.param_groups for parameter in group["params"]
        }
        assert held == {
            id(parameter) for parameter in self.geometry.parameters() if parameter.numel()
        }
        assert {id(parameter) for parameter in self.optimizer.state} <= held
        fresh = torch.zeros(len(self.geometry), dtype=torch.bool)
        for i, parameter in enumerate(self.parameters()):
            state = self.optimizer.state[parameter]
            zero = (state["exp_avg"].reshape(len(fresh), -1) == 0).all(1)
            fresh = zero if i == 0 else fresh
            past = torch.where(
                zero.reshape(-1, *[1] * (parameter.dim() - 1)), 0.0, spelt(self.ids(), parameter)
            )
            assert (
                torch.equal(zero, fresh)
                and torch.equal(state["exp_avg"], past)
                and torch.equal(state["exp_avg_sq"], 2 * past)
            )
        return fresh


def spelt(ids: torch.Tensor, parameter: torch.Tensor) -> torch.Tensor:
    return ids.reshape(-1, *[1] * (parameter.dim() - 1)).expand_as(parameter).clone()


@row("A3", "Optimiser state mismatch")
@pytest.mark.parametrize("seed", range(100))
def test_moments_follow_their_gaussian(seed, measured):
    """Random rounds of cloning, splitting, dropping, capping and pruning to a budget; in a third of
    the sequences before any step.
    """
    g = torch.Generator().manual_seed(seed)
    rules = EVERY_STEP | {"grad_threshold": 0.6, "split_scale": 0.018, "min_opacity": 0.3}
    options = {
        "sh_degree": seed % 2,
        "min_gaussians": 5,
        "max_gaussians": 40,
        "budget": (None, 20)[seed // 2 % 2],
    }
    geometry = started(30, **options, densify=rules, prune={"start": 0, "stop": 99, "every": 2})
    optimizer = torch.optim.Adam([{**group, "lr": 0.0} for group in geometry.parameter_groups()])
    ledger, new, gone = Ledger(geometry, optimizer), 0, 0
    for round_ in range(1, 6):
        n = len(geometry)
        geometry.log_scales.data = -4.0 + 0.2 * torch.randn(n, 3, generator=g)
        geometry.logit_opacities.data = torch.randn(n, generator=g)
        if round_ > 1 or seed % 3:
            for parameter in geometry.parameters():
                parameter.grad = torch.ones_like(parameter)
            optimizer.step()
        steps = [optimizer.state[parameter]["step"].item() for parameter in ledger.parameters()]
        ids, gradient = torch.arange(1.0, n + 1), torch.rand(n, generator=g)
        ledger.write(ids)
        seen_alike(geometry, gradient, torch.rand(n, generator=g))
        DensityControl(geometry).after_step(optimizer, round_)
        left = ledger.ids()
        assert steps == [
            optimizer.state[parameter]["step"].item() for parameter in ledger.parameters()
        ]
        if steps:
            fresh = ledger.fresh()
            assert len(left[~fresh].unique()) == int((~fresh).sum())  # nobody's past is there twice
            assert torch.isin(
                left[fresh], ids[gradient > 0.6]
            ).all()  # new ones come of those that were selected
            new += int(fresh.sum())
        gone += n - len(left.unique())
    assert new > 5 and gone > 5
    measured("to the bit")


@row("A3", "Lost step")
def test_a_round_that_selects_nobody_is_none(measured):
    """Five rounds between three prunings, for whose scores they must not count: parameters and
    moments, bit for bit.
    """
    nobody = EVERY_STEP | NO_LIMITS | {"every": 2, "grad_threshold": 1e9}
    pruned = {"budget": 100, "prune": {"start": 0, "stop": 99, "every": 3}}
    runs = [Training(started(**pruned)), Training(started(**pruned, densify=nobody))]
    assert [training.run(10)[-1] for training in runs] == [102, 102]
    plain, idle = (training.geometry.parameters_by_name() for training in runs)
    moved = sum(int((plain[name] != idle[name]).sum()) for name in PARAMETERS)
    for name in (name for name in PARAMETERS if plain[name] in runs[0].optimizer.state):
        states = [
            training.optimizer.state[parameters[name]]
            for training, parameters in zip(runs, (plain, idle), strict=True)
        ]
        assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])
    measured(moved, "numbers that differ", at_most=0)


@row("A3", "Lost step")
def test_a_round_takes_no_step_from_those_that_stay(measured):
    """All of them are cloned after the third step: each original is where it would be without."""
    everybody = EVERY_STEP | NO_LIMITS | {"start": 3, "grad_threshold": 0.0, "split_scale": 1e9}
    runs = [Training(started()), Training(started(densify=everybody))]
    counts = [training.run(3) for training in runs]
    assert counts[1][-1] > 350
    plain, cloned = (training.geometry.parameters_by_name() for training in runs)
    measured(
        sum(int((plain[name] != cloned[name][:200]).sum()) for name in PARAMETERS),
        "numbers that differ",
        at_most=0,
    )


SCHEDULES = [f"system.geometry.{key}" for key in (
    "prior.num_points=180", "budget=100", "densify.enabled=true", "densify.start=10",
    "densify.stop=95", "densify.every=10", "densify.grad_threshold=1e-4", "densify.min_opacity=0.2",
    "densify.absgrad=true", "prune.start=15", "prune.stop=95", "prune.every=15",
)]  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Ended:
    """A run that nothing disturbs, with a checkpoint of every step."""
    return launch(
        tmp_path_factory.mktemp("whole"),
        *SCHEDULES,
        "trainer.max_steps=100",
        "checkpoint.every_n_train_steps=1",
    )


def at_step(run: Ended, step: int) -> Path:
    return run.folder / f"ckpts/epoch=0-step={step}.ckpt"


def newcomers(run: Ended, step: int) -> int:
    """How many Gaussians have no moments yet: the round at this very step made them."""
    return int(
        (run.checkpoint(at_step(run, step))["optimizer_states"][0]["state"][0]["exp_avg_sq"] == 0)
        .all(1)
        .sum()
    )


def cloud_hash(run: Ended) -> str:
    values = run.checkpoint()["state_dict"]
    return hashlib.sha256(
        b"".join(
            values[f"geometry.{name}"].numpy().tobytes() for name in (*PARAMETERS, *STATISTICS)
        )
    ).hexdigest()


@pytest.mark.slow
@row("A3", "Densify x resume")
@pytest.mark.parametrize("k", [29, 30, 31, 35, 90])
def test_resumed_anywhere_the_cloud_is_the_same(k, whole, tmp_path, measured):
    """A tenth of the steps of the row: the stops lie before, at and after a round that densifies
    and prunes, between rounds, at the last.

    The stops' checkpoints are those of the undisturbed run, so that they are also shown to disturb
    nothing."""
    counts = [
        len(whole.checkpoint(at_step(whole, step))["state_dict"]["geometry.means"])
        for step in (29, 30, 31)
    ]
    assert counts[0] > counts[1] == counts[2]
    assert newcomers(whole, 30) > newcomers(whole, 29) and newcomers(whole, 90) > newcomers(
        whole, 89
    )
    resumed = launch(tmp_path, *SCHEDULES, "trainer.max_steps=100", f"resume={at_step(whole, k)}")
    assert resumed.code == 0 and cloud_hash(whole) == cloud_hash(resumed)
    measured(
        differences(whole.checkpoint(), resumed.checkpoint()),
        "tensors that differ, moments too",
        at_most=0,
    )


# ---- what the threshold means --------------------------------------------------------------------


def judged(
    size: int = 128,
    batch: int = 4,
    loss_scale: float = 1.0,
    autocast: bool = False,
    absgrad: bool = False,
) -> GaussianCloud:
    """The first cloud after the four views were seen, ``batch`` at a time."""
    geometry = started(densify=EVERY_STEP | NO_LIMITS | {"absgrad": absgrad})
    training = Training(geometry, size)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        for first in range(0, 4, batch):
            training.observe(slice(first, first + batch), loss_scale)
    return geometry


def selected(geometry: GaussianCloud, threshold: float) -> set[int]:
    geometry.cfg.densify.grad_threshold = threshold
    change = DensityControl(geometry).densified(1)
    return set(change.parents[change.is_new].tolist())


def middle(geometry: GaussianCloud) -> float:
    return (geometry.gradient_sum / geometry.gradient_count.clamp_min(1)).median().item()


each_gradient = pytest.mark.parametrize("absgrad", [False, True], ids=["gradient", "absgrad"])


@row("A3", "Threshold's meaning")
@each_gradient
@pytest.mark.parametrize(
    "other",
    [
        {"loss_scale": 65536.0},
        {"loss_scale": 65536.0, "autocast": True},
        {"batch": 1},
        {"batch": 2},
    ],
    ids=str,
)
def test_neither_precision_nor_batch_chooses(other, absgrad, measured):
    """Half of the Gaussians lie above the threshold. The loss is the mean over the batch, as a
    guidance's is.
    """
    usual = judged(absgrad=absgrad)
    threshold = middle(usual)
    expected, found = (
        selected(usual, threshold),
        selected(judged(**other, absgrad=absgrad), threshold),
    )
    assert 80 < len(expected) < 120
    measured(len(expected ^ found), "selected differently, of 200", at_most=0)


@row("A3", "Threshold's meaning")
@each_gradient
@pytest.mark.parametrize("size", [128, 256])
def test_resolution_hardly_chooses(size, absgrad, measured):
    """Twice the resolution of a loss that doesn't depend on it; what changes is what the pixels'
    dilation of 0.3 covers.
    """
    usual, finer = judged(size, absgrad=absgrad), judged(2 * size, absgrad=absgrad)
    threshold = middle(usual)
    first, second, in_pixels = (
        selected(usual, threshold),
        selected(finer, threshold),
        selected(finer, 2 * threshold),
    )
    measured(len(first & second) / len(first | second) * 100, "% overlap", at_least=90.0)
    assert len(first & in_pixels) < 0.9 * len(
        first | in_pixels
    )  # a pixel is half as large there: the test can fail


@row("A3", "Saturated 0/0")
@each_gradient
def test_the_never_seen_are_never_selected(absgrad, measured):
    """Fifty Gaussians out of every view, and a threshold that all others reach."""
    geometry = started(densify=EVERY_STEP | NO_LIMITS | {"absgrad": absgrad, "grad_threshold": 0.0})
    geometry.means.data[:50] = torch.tensor([0.0, 0.0, 1e4])
    training = Training(geometry)
    training.observe(slice(None))
    assert (geometry.gradient_count[:50] == 0).all() and geometry.gradient_sum.isfinite().all()
    chosen = selected(geometry, 0.0)
    assert len(chosen) > 120
    training.optimizer.step()
    DensityControl(geometry).after_step(training.optimizer, 1)
    assert all(parameter.isfinite().all() for parameter in geometry.parameters())
    measured(len(chosen & set(range(50))), "of 50 selected", at_most=0)


# ---- opacity reset -------------------------------------------------------------------------------


@row("A3", "Opacity reset")
def test_nothing_resets_the_opacities(measured, monkeypatch):
    """There is no such option, and 35 rounds (a reset comes every 3000 steps elsewhere) leave the
    opacities as they are.
    """
    with pytest.raises(UserError, match="opacity_reset"):
        check_config(load_config(DEMO, cli_args=["system.geometry.densify.opacity_reset=3000"]))
    geometry = started(densify=EVERY_STEP | NO_LIMITS | {"every": 100, "grad_threshold": 1e9})
    before, optimizer = (
        geometry.logit_opacities.detach().clone(),
        torch.optim.Adam(geometry.parameter_groups()),
    )
    rounds, once = [], densify.densify_and_prune
    monkeypatch.setattr(
        densify, "densify_and_prune", lambda *args: rounds.append(once(*args)) or rounds[-1]
    )
    for step in range(1, 3501):
        DensityControl(geometry).after_step(optimizer, step)
    assert len(rounds) == 35
    measured((geometry.logit_opacities - before).abs().max(), "moved by 35 rounds", at_most=0.0)


@row("A3", "Opacity reset")
def test_a_reset_by_hand_is_recovered_from(measured):
    """To 0.01, after 100 steps; with an absolute error, which score distillation doesn't give: it
    pulls at what is still visible.
    """
    training = Training(started())
    training.optimizer.param_groups[3]["lr"] = 0.1
    training.run(100)
    before = training.quality()
    training.geometry.logit_opacities.data.fill_(math.log(0.01 / 0.99))
    after = training.quality()
    training.run(200)
    assert after < before - 5
    measured(
        training.quality() - before, "dB over what was there, 200 steps after it", at_least=-0.5
    )

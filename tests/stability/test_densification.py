"""A3: densification at its limits, and its state over resumes."""

import math
from collections.abc import Iterator
from types import SimpleNamespace
from unittest import mock

import pytest
import torch

from tests.fuzz.sequences import CloudSequence, run_sequences
from tests.helpers.gallery import differences
from tests.stability import scenes
from tests.stability.backends import slow
from tests.stability.report import row
from tests.stability.small_runs import DEMO, Ended, launch
from threestudio_gaussiandreamer.cameras import orbit_c2w
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.streams import generator
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.gaussians import densify
from threestudio_gaussiandreamer.gaussians.densify import PARAMETERS
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.views import render_all, views_around
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.training.density import DensifyConfig, DensityControl
from threestudio_gaussiandreamer.training.geometry import GaussianCloud

NO_LIMITS = {"min_opacity": 0.0, "max_scale": 1e9}
EACH_STEP = {"start": 0, "stop": 10_000, "every": 1}
EVERY_STEP = EACH_STEP | {"enabled": True, "start": 1}
SCALED = {"loss_scale": 65536.0}
each_gradient = pytest.mark.parametrize("absgrad", [False, True], ids=["gradient", "absgrad"])


def started(n: int = 200, seed: int = 0, **options) -> GaussianCloud:
    return scenes.started(n, seed, **{"init_opacity": 0.5, **options})


class Training:
    """The system's training step, fitting renders of another cloud from four fixed cameras."""

    def __init__(self, geometry: GaussianCloud, size: int = 32) -> None:
        self.geometry, self.size, self.step = geometry, size, 0
        angles = torch.arange(4)
        self.c2w = orbit_c2w(10.0 * angles, 90.0 * angles + 20, torch.full((4,), 2.5))
        self.fovy = torch.full((4,), 0.8)
        self.truth = self.render(started(150, seed=1, init_opacity=0.9)).comp_rgb.detach()
        groups = [{**group, "lr": 1e-2} for group in geometry.parameter_groups()]
        self.optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)

    def render(self, geometry: GaussianCloud, views: slice = slice(None)) -> SimpleNamespace:
        behind = find("gaussiandreamer-background")({"mode": "fixed", "color": [1.0, 1.0, 1.0]})
        parts = {"geometry": geometry, "material": None, "background": behind}
        renderer = find("gaussiandreamer-splatting")({}, **parts)
        return SimpleNamespace(**renderer(self.c2w[views], self.fovy[views], self.size, self.size))

    def observe(self, views: slice = slice(None), loss_scale: float = 1.0) -> None:
        """Render, backpropagate the mean squared error of the batch, and update the statistics."""
        out, size = self.render(self.geometry, views), self.size
        loss = ((out.comp_rgb - self.truth[views]) ** 2).mean()
        (loss * loss_scale).backward()
        DensityControl(self.geometry).after_backward(out.rasterized, size, size, loss_scale)

    def run(self, steps: int) -> list[int]:
        """Return the number of Gaussians after each step."""
        counts = []
        for _ in range(steps):
            self.observe()
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
            self.step += 1
            DensityControl(self.geometry).after_step(self.optimizer, self.step)
            counts.append(len(self.geometry))
        return counts


SCHEDULES = [f"system.geometry.{key}" for key in (
    "prior.num_points=180", "init_opacity=0.3", "budget=100", "densify.enabled=true",
    "densify.start=30", "densify.stop=95", "densify.every=10", "densify.grad_threshold=1e-4",
    "densify.min_opacity=0.4", "densify.absgrad=true", "prune.start=15", "prune.stop=95",
    "prune.every=15", "prune.keep=0.8", "lr_means_unit=world", "lr_means=8e-4",
)]  # fmt: skip


def drawn(geometry: GaussianCloud) -> Gaussians:
    return Gaussians.of(geometry).map(torch.Tensor.detach)


@row("A3", "Explosion")
@pytest.mark.parametrize("limit", ["max_gaussians", "budget"])
@each_gradient
def test_threshold_zero_fills_the_cap_and_no_more(limit, absgrad, measured):
    """Every visible Gaussian is selected at every step: 200, 400, then 500 from then on."""
    growing = EVERY_STEP | NO_LIMITS | {"grad_threshold": 0.0, "absgrad": absgrad}
    counts = Training(started(**{limit: 500}, densify=growing, prune=EACH_STEP)).run(12)
    measured(max(counts), "Gaussians, cap 500", at_most=500)
    measured(min(counts[2:]), "Gaussians, once it is full", at_least=500)


@row("A3", "Explosion")
def test_a_trained_cloud_that_is_too_large_keeps_what_contributes(tmp_path, measured, said):
    """Half of 400 trained Gaussians are hidden or faint."""
    trained, path = started(400), str(tmp_path / "a.ply")
    trained.means.data[::2] *= torch.linspace(0.1, 0.9, 200)[:, None]
    noise = torch.randn(400, generator=generator(0, "o"))
    trained.logit_opacities.data = noise * 2 + torch.arange(400) % 2 * 2
    write_cloud(path, StoredCloud(drawn(trained).arrays()))
    prior = {"prior_type": "gaussians-prior", "prior": {"path": path}}
    geometry = GaussianCloud({**prior, "max_gaussians": 150})
    geometry.initialize("a prompt")
    assert len(geometry) == 150
    assert "has 400 Gaussians; keeping the 150" in said.text
    views = views_around(drawn(trained), 4, 64, turn=30)

    def psnr_to_trained(cloud: Gaussians) -> float:
        return psnr(render_all(cloud, views), render_all(drawn(trained), views)).mean().item()

    lots = [torch.randperm(400, generator=generator(seed, "lottery"))[:150] for seed in range(5)]
    luckiest = max(psnr_to_trained(drawn(trained).rows(rows)) for rows in lots)
    better = psnr_to_trained(drawn(geometry)) - luckiest
    measured(better, "dB better than the best of 5 random choices", at_least=2.0)


@row("A3", "Collapse to 0")
@pytest.mark.parametrize(
    "rules", [{"min_opacity": 1.1}, {"min_opacity": 0.05, "max_scale": 1e-6}], ids=str
)
def test_the_floor_keeps_what_contributes_most(rules, measured, said):
    geometry = started()
    Training(geometry).observe()
    statistics, rng = (geometry.gradient_sum, geometry.contribution), generator(0, "s")
    rest = *statistics, DensifyConfig(grad_threshold=1e9, **rules), 64, 500_000, rng
    change = densify.densify_and_prune(geometry.parameters_by_name(), *rest)
    assert torch.equal(change.parents, geometry.contribution.topk(64).indices.sort().values)
    (message,) = said.messages
    assert message.startswith("only 0 of 200 Gaussians would be left: the 64 that contribute most")
    measured(len(change.parents), "left", at_least=64)


@row("A3", "N=1 squeeze")
@each_gradient
@pytest.mark.parametrize("n", [1, 2, 3])
def test_very_few_keep_their_shapes(n, absgrad, measured):
    """Clones, splits and prunes after training steps; the counts show that each happened."""
    prune = {"start": 2, "stop": 100, "every": 2}
    for split_scale in (1e9, 1e-9):
        selecting = {"grad_threshold": 0.0, "split_scale": split_scale, "absgrad": absgrad}
        rules = EVERY_STEP | NO_LIMITS | selecting
        geometry = started(n, min_gaussians=1, densify=rules, prune=prune, budget=2 * n)
        training = Training(geometry)
        assert training.run(1) == [2 * n]
        geometry.cfg.budget, geometry.cfg.densify.grad_threshold = 1, 1e9
        assert training.run(1) == [max(1, int(0.8 * 2 * n))]
        for name, like in started(1).state_dict().items():
            shape = (len(geometry), *like.shape[1:]) if like.dim() else ()
            assert getattr(geometry, name).shape == shape, name
    measured("clone, split and prune: (M, ...)")


@row("A3", "MCMC relocation with no live Gaussian / all-zero opacity")
@pytest.mark.parametrize("budget", [None, 100, "auto"])
def test_a_transparent_cloud_shrinks_to_the_floor(budget, measured):
    """Nothing is relocated, so no distribution without mass is sampled."""
    growing = EVERY_STEP | {"start": 5, "grad_threshold": 0.0}
    geometry = started(budget=budget, prune=EACH_STEP | {"start": 1}, densify=growing)
    geometry.logit_opacities.data[:100], geometry.logit_opacities.data[100:] = -15.0, -math.inf
    training = Training(geometry)
    counts = training.run(8)
    assert (training.render(geometry).comp_rgb == 1).all()  # the background alone
    for name in set(PARAMETERS) - {"logit_opacities"}:
        assert getattr(geometry, name).isfinite().all()
    assert counts == sorted(counts, reverse=True)
    measured(counts[-1], "left of 200 transparent ones", at_least=64)


@row("A3", "Optimiser state mismatch")
@pytest.mark.parametrize("sequences", [5, *slow(50)])
def test_moments_follow_their_gaussian(sequences, measured, monkeypatch):
    """Random sequences of all operations, some of which begin before any step."""
    monkeypatch.setattr(CloudSequence, "steps", 0)
    run_sequences(sequences)
    assert CloudSequence.steps > 10 * sequences
    measured("to the bit")


def parameters_of(runs: list[Training]) -> Iterator[tuple[torch.nn.Parameter, ...]]:
    return zip(*(run.geometry.parameters_by_name().values() for run in runs), strict=True)


@row("A3", "Lost step")
def test_a_round_that_selects_no_gaussian_changes_nothing(measured):
    """Five rounds between three prunings, whose scores must not count them."""
    none_selected = EVERY_STEP | NO_LIMITS | {"every": 2, "grad_threshold": 1e9}
    pruned = {"budget": 100, "prune": {"start": 0, "stop": 99, "every": 3}}
    runs = [Training(started(**pruned)), Training(started(**pruned, densify=none_selected))]
    assert [training.run(10)[-1] for training in runs] == [102, 102]
    for pair in parameters_of(runs):
        one, other = (run.optimizer.state.get(p, {}) for run, p in zip(runs, pair, strict=True))
        assert one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)
    moved = sum((plain != idle).sum() for plain, idle in parameters_of(runs))
    measured(moved, "numbers that differ", at_most=0)


@row("A3", "Lost step")
def test_a_round_takes_no_step_from_those_that_stay(measured):
    """All are cloned after the third step."""
    everybody = EVERY_STEP | NO_LIMITS | {"start": 3, "grad_threshold": 0.0, "split_scale": 1e9}
    runs = [Training(started()), Training(started(densify=everybody))]
    counts = [training.run(3) for training in runs]
    assert counts[1][-1] > 350
    moved = sum((plain != cloned[:200]).sum() for plain, cloned in parameters_of(runs))
    measured(moved, "numbers that differ", at_most=0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Ended:
    """Return an uninterrupted run with a checkpoint of every step."""
    steps = "trainer.max_steps=100", "checkpoint.every_n_train_steps=1"
    return launch(tmp_path_factory.mktemp("whole"), *SCHEDULES, *steps)


def counts_at(run: Ended, step: int) -> tuple[int, int]:
    """Count the Gaussians, and those without moments, which were created at this step."""
    state = run.checkpoint(run.at_step(step))["optimizer_states"][0]["state"][0]["exp_avg_sq"]
    return len(state), int((state == 0).all(1).sum())


@pytest.mark.slow
@row("A3", "Densify x resume")
@pytest.mark.parametrize("k", [29, 30, 31, 35, 90])
def test_resumed_anywhere_the_cloud_is_the_same(k, whole, tmp_path, measured):
    """Before, at and after a round that densifies and prunes, between rounds, and at the last."""
    counts, new = zip(*(counts_at(whole, step) for step in (29, 30, 31, 89, 90)), strict=True)
    assert counts[0] > counts[1] == counts[2] and new[1] > new[0] and new[4] > new[3]
    resumed = launch(tmp_path, *SCHEDULES, "trainer.max_steps=100", f"resume={whole.at_step(k)}")
    differing = differences(whole.checkpoint(), resumed.checkpoint())
    measured(differing, "tensors that differ, moments too", at_most=0)


def accumulated(size=128, batch=4, loss_scale=1.0, autocast=False, absgrad=False) -> GaussianCloud:
    """Return the first cloud after the four views were processed, ``batch`` at a time."""
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
    """Return a threshold with as many Gaussians above as below, and none on it."""
    gradients = geometry.gradient_sum / geometry.gradient_count.clamp_min(1)
    return gradients.double().quantile(0.5).item()


@row("A3", "Threshold's meaning")
@each_gradient
@pytest.mark.parametrize("other", [{"batch": 1}, SCALED, SCALED | {"autocast": True}], ids=str)
def test_neither_precision_nor_batch_affects_the_selection(other, absgrad, measured):
    """Half of the Gaussians are above the threshold; the loss is the mean over the batch."""
    usual = accumulated(absgrad=absgrad)
    threshold = middle(usual)
    expected = selected(usual, threshold)
    found = selected(accumulated(**other, absgrad=absgrad), threshold)
    assert 80 < len(expected) < 120
    measured(len(expected ^ found), "selected differently, of 200", at_most=0)


@pytest.mark.slow
@row("A3", "Threshold's meaning")
@each_gradient
@pytest.mark.parametrize("size", [128, 256])
def test_resolution_hardly_affects_the_selection(size, absgrad, measured):
    """With a loss that doesn't depend on it; only the effect of the dilation changes."""
    usual, finer = accumulated(size, absgrad=absgrad), accumulated(2 * size, absgrad=absgrad)
    threshold = middle(usual)
    first, second = selected(usual, threshold), selected(finer, threshold)
    in_pixels = selected(finer, 2 * threshold)
    measured(len(first & second) / len(first | second) * 100, "% overlap", at_least=90.0)
    assert len(first & in_pixels) < 0.9 * len(first | in_pixels)


@row("A3", "Saturated 0/0")
@each_gradient
def test_gaussians_outside_every_view_are_never_selected(absgrad, measured):
    """Fifty Gaussians outside every view, and a threshold that all others reach."""
    geometry = started(densify=EVERY_STEP | NO_LIMITS | {"absgrad": absgrad, "grad_threshold": 0.0})
    geometry.means.data[:50] = torch.tensor([0.0, 0.0, 1e4])
    training = Training(geometry)
    training.observe()
    assert (geometry.gradient_count[:50] == 0).all() and geometry.gradient_sum.isfinite().all()
    chosen = selected(geometry, 0.0)
    assert len(chosen) > 120
    training.optimizer.step()
    DensityControl(geometry).after_step(training.optimizer, 1)
    assert all(parameter.isfinite().all() for parameter in geometry.parameters())
    measured(len(chosen & set(range(50))), "of 50 selected", at_most=0)


@pytest.mark.slow
@row("A3", "Opacity reset")
def test_nothing_resets_the_opacities(measured, monkeypatch):
    """There is no such option, and 35 rounds leave the opacities unchanged."""
    with pytest.raises(UserError, match="opacity_reset"):
        check_config(load_config(DEMO, cli_args=["system.geometry.densify.opacity_reset=3000"]))
    geometry = started(densify=EVERY_STEP | NO_LIMITS | {"every": 100, "grad_threshold": 1e9})
    before = geometry.logit_opacities.detach().clone()
    optimizer = torch.optim.Adam(geometry.parameter_groups())
    rounds = mock.Mock(wraps=densify.densify_and_prune)
    monkeypatch.setattr(densify, "densify_and_prune", rounds)
    for step in range(1, 3501):
        DensityControl(geometry).after_step(optimizer, step)
    assert rounds.call_count == 35
    measured((geometry.logit_opacities - before).abs().max(), "moved by 35 rounds", at_most=0.0)

"""Densification and pruning keep every row of optimiser state with its Gaussian."""

import hashlib
from pathlib import Path

import pytest
import torch

from tests.stability.densification_cases import (
    EVERY_STEP,
    NO_LIMITS,
    SCHEDULES,
    Training,
    started,
)
from tests.stability.rows import row
from tests.stability.small_runs import Ended, differences, launch
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.gaussians.densify import PARAMETERS
from threestudio_gaussiandreamer.training.density import DensityControl
from threestudio_gaussiandreamer.training.geometry import STATISTICS, GaussianCloud

register_parts()


def seen_alike(geometry: GaussianCloud, gradient: torch.Tensor, contribution: torch.Tensor) -> None:
    """Set statistics as if one view had seen every Gaussian."""
    geometry.gradient_sum.copy_(gradient)
    geometry.gradient_count.fill_(1)
    geometry.contribution.copy_(contribution)


# ---- state ---------------------------------------------------------------------------------------


class Ledger:
    """Give every Gaussian an id, stored in its colour and in the moments of all its parameters, and
    check them later.
    """

    def __init__(self, geometry: GaussianCloud, optimizer: torch.optim.Optimizer) -> None:
        self.geometry, self.optimizer = geometry, optimizer

    def parameters(self) -> list[torch.nn.Parameter]:
        """Return those with state; spherical harmonics above degree 0 may be empty."""
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

    def is_new(self) -> torch.Tensor:
        """Return which Gaussians have no moments; the moments of all others must be their own, bit
        for bit.
        """
        held = {
            id(parameter) for group in self.optimizer.param_groups for parameter in group["params"]
        }
        assert held == {
            id(parameter) for parameter in self.geometry.parameters() if parameter.numel()
        }
        assert {id(parameter) for parameter in self.optimizer.state} <= held
        is_new = torch.zeros(len(self.geometry), dtype=torch.bool)
        for i, parameter in enumerate(self.parameters()):
            state = self.optimizer.state[parameter]
            zero = (state["exp_avg"].reshape(len(is_new), -1) == 0).all(1)
            is_new = zero if i == 0 else is_new
            past = torch.where(
                zero.reshape(-1, *[1] * (parameter.dim() - 1)), 0.0, spelt(self.ids(), parameter)
            )
            assert (
                torch.equal(zero, is_new)
                and torch.equal(state["exp_avg"], past)
                and torch.equal(state["exp_avg_sq"], 2 * past)
            )
        return is_new


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
            is_new = ledger.is_new()
            assert len(left[~is_new].unique()) == int((~is_new).sum())  # no history is duplicated
            assert torch.isin(
                left[is_new], ids[gradient > 0.6]
            ).all()  # new Gaussians derive from selected ones
            new += int(is_new.sum())
        gone += n - len(left.unique())
    assert new > 5 and gone > 5
    measured("to the bit")


@row("A3", "Lost step")
def test_a_round_that_selects_no_gaussian_changes_nothing(measured):
    """Five rounds between three prunings, whose scores must not count them: parameters and moments,
    bit for bit.
    """
    none_selected = EVERY_STEP | NO_LIMITS | {"every": 2, "grad_threshold": 1e9}
    pruned = {"budget": 100, "prune": {"start": 0, "stop": 99, "every": 3}}
    runs = [Training(started(**pruned)), Training(started(**pruned, densify=none_selected))]
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
    """All are cloned after the third step; each original is where it would be without
    densification.
    """
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


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Ended:
    """Return an uninterrupted run with a checkpoint of every step."""
    return launch(
        tmp_path_factory.mktemp("whole"),
        *SCHEDULES,
        "trainer.max_steps=100",
        "checkpoint.every_n_train_steps=1",
    )


def at_step(run: Ended, step: int) -> Path:
    return run.folder / f"ckpts/epoch=0-step={step}.ckpt"


def newcomers(run: Ended, step: int) -> int:
    """Count the Gaussians without moments: those created at this step."""
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
    """A tenth of the row's steps: stops before, at and after a round that densifies and prunes,
    between rounds, and at the last.

    The checkpoints are those of the uninterrupted run, which shows that writing them changes
    nothing.
    """
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

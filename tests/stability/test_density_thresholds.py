"""The meaning of the densification threshold, and opacity resets."""

import math

import pytest
import torch

from tests.stability.densification_cases import EVERY_STEP, NO_LIMITS, Training, started
from tests.stability.rows import row
from tests.stability.small_runs import DEMO
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.gaussians import densify
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.training.density import DensityControl
from threestudio_gaussiandreamer.training.geometry import GaussianCloud

register_parts()


# ---- what the threshold means --------------------------------------------------------------------


def accumulated(
    size: int = 128,
    batch: int = 4,
    loss_scale: float = 1.0,
    autocast: bool = False,
    absgrad: bool = False,
) -> GaussianCloud:
    """Return the first cloud after the four views were processed, ``batch`` at a time."""
    geometry = started(densify=EVERY_STEP | NO_LIMITS | {"absgrad": absgrad})
    training = Training(geometry, size)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        for first in range(0, 4, batch):
            training.observe(slice(first, first + batch), loss_scale)
    return geometry


def selected(geometry: GaussianCloud, threshold: float) -> set[int]:
    geometry.options.densify.grad_threshold = threshold
    change = DensityControl(geometry).densified(1)
    return set(change.parents[change.is_new].tolist())


def middle(geometry: GaussianCloud) -> float:
    """Return a threshold with as many Gaussians above as below, and none on it."""
    gradients = geometry.gradient_sum / geometry.gradient_count.clamp_min(1)
    return gradients.double().quantile(0.5).item()


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
def test_neither_precision_nor_batch_affects_the_selection(other, absgrad, measured):
    """Half of the Gaussians are above the threshold. The loss is the mean over the batch, like a
    guidance's.
    """
    usual = accumulated(absgrad=absgrad)
    threshold = middle(usual)
    expected, found = (
        selected(usual, threshold),
        selected(accumulated(**other, absgrad=absgrad), threshold),
    )
    assert 80 < len(expected) < 120
    measured(len(expected ^ found), "selected differently, of 200", at_most=0)


@row("A3", "Threshold's meaning")
@each_gradient
@pytest.mark.parametrize("size", [128, 256])
def test_resolution_hardly_affects_the_selection(size, absgrad, measured):
    """Twice the resolution, with a loss that does not depend on it; only the effect of the dilation
    of 0.3 square pixels changes.
    """
    usual, finer = accumulated(size, absgrad=absgrad), accumulated(2 * size, absgrad=absgrad)
    threshold = middle(usual)
    first, second, in_pixels = (
        selected(usual, threshold),
        selected(finer, threshold),
        selected(finer, 2 * threshold),
    )
    measured(len(first & second) / len(first | second) * 100, "% overlap", at_least=90.0)
    assert len(first & in_pixels) < 0.9 * len(
        first | in_pixels
    )  # a pixel is half as large there, so the gradients in pixels differ


@row("A3", "Saturated 0/0")
@each_gradient
def test_gaussians_outside_every_view_are_never_selected(absgrad, measured):
    """Fifty Gaussians outside every view, and a threshold that all others reach."""
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
    """There is no such option, and 35 rounds (others reset every 3000 steps) leave the opacities
    unchanged.
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
    """To 0.01, after 100 steps; with an absolute error, because score distillation only acts on
    what is still visible.
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
        training.quality() - before,
        "dB above the quality before the reset, after 200 steps",
        at_least=-0.5,
    )

"""Rectified flow as a diffusion: conversions, and the expected gradient in closed form."""

import pytest
import torch

from tests.diffusion.test_exact_score import denoised
from threestudio_gaussiandreamer.diffusion import rectified_flow, sds

SIGMA = torch.tensor([0.002, 0.3, 0.6, 0.95, 0.999], dtype=torch.float64)


def randn(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_a_noisy_latent_lies_on_the_straight_path():
    x, eps = randn(2, 5, 7)
    abar = rectified_flow.abar_of_sigma(SIGMA)
    torch.testing.assert_close(rectified_flow.sigma_of_abar(abar), SIGMA)
    torch.testing.assert_close(((1 - abar) / abar).sqrt(), SIGMA / (1 - SIGMA))
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
    assert rectified_flow.abar_of_sigma(ends).tolist() == [1.0, 0.0]
    assert rectified_flow.sigma_of_abar(1 - ends).tolist() == [0.0, 1.0]
    z = sds.diffuse(x, eps, abar)
    path = (1 - SIGMA)[:, None] * x + SIGMA[:, None] * eps
    torch.testing.assert_close(rectified_flow.on_path(z, abar), path)
    torch.testing.assert_close(rectified_flow.noise_of_velocity(eps - x, z, abar), eps)


def test_the_scheduler_of_diffusers_has_the_same_sigmas():
    scheduler = pytest.importorskip("diffusers").FlowMatchEulerDiscreteScheduler(shift=3.0)
    sigmas = rectified_flow.shifted_sigmas(1000, 3.0)
    # theirs are in decreasing order and end at timestep 1
    torch.testing.assert_close(
        scheduler.sigmas.flip(0)[:-1].double(), sigmas[1:], rtol=1e-6, atol=0
    )
    assert sigmas[0] == 0 and (sigmas.diff() > 0).all()


@pytest.mark.parametrize("sigma", [0.05, 0.5, 0.95])
def test_a_mixtures_velocity_is_its_score(sigma):
    """The velocity's posterior, in the flow's own variables, against the exact score."""
    centers, shares = randn(4, 3), torch.tensor([0.1, 0.2, 0.3, 0.4]).double()
    level = torch.tensor([sigma], dtype=torch.float64)
    abar = rectified_flow.abar_of_sigma(level)
    z = randn(1, 3, seed=1)
    eps, _ = denoised(z, abar, centers, shares.log()[None])
    on_path = rectified_flow.on_path(z, abar)
    gaps = (on_path - (1 - sigma) * centers).square().sum(1)
    x0 = torch.softmax(shares.log() - gaps / (2 * sigma**2), 0) @ centers
    found = rectified_flow.noise_of_velocity((on_path - x0) / sigma, z, abar)  # E[eps - x | z]
    torch.testing.assert_close(found, eps, rtol=1e-9, atol=1e-9)


def test_the_weight_of_x0_gives_the_distance_to_the_denoised_picture():
    x, eps, guess = randn(3, 5, 7)
    abar = rectified_flow.abar_of_sigma(SIGMA)
    z = sds.diffuse(x, eps, abar)
    torch.testing.assert_close(sds.predict_x0(z, eps, abar), x)
    grad = sds.per_item(sds.WEIGHTS["x0"](abar), eps) * (guess - eps)
    torch.testing.assert_close(grad, x - sds.predict_x0(z, guess, abar), rtol=1e-9, atol=1e-9)

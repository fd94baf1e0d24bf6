"""Sampling along Karras' schedules, with and without guidance."""

import math

import numpy as np
import pytest
import torch

from tests.priors.cases import seeded
from threestudio_gaussiandreamer.priors import karras

MEAN, SPREAD = 0.3, 0.5


def gaussian_denoiser(x, sigma):
    """Return E[x0 | x0 + sigma eps] of normal data with this mean and standard deviation."""
    return MEAN + SPREAD**2 / (SPREAD**2 + sigma**2) * (x - MEAN)


def test_the_sampler_follows_the_flow_to_second_order():
    """The probability flow keeps the quantile of the widening normal distribution."""
    sigmas = karras.karras_sigmas(64, 160)
    assert len(sigmas) == 65 and sigmas[-1] == 0
    assert (sigmas[0], sigmas[-2]) == pytest.approx((160, 1e-3))
    steps = np.diff(np.array(sigmas[:-1]) ** (1 / 7))
    np.testing.assert_allclose(steps, (1e-3 ** (1 / 7) - 160 ** (1 / 7)) / 63, rtol=1e-9)
    noise = torch.randn(200, generator=seeded(), dtype=torch.float64)
    end = MEAN + SPREAD / math.hypot(SPREAD, 120) * (120 * noise - MEAN)
    errors = []
    for steps in (16, 32, 64, 128):
        sigmas = karras.karras_sigmas(steps, 120)
        sample = karras.sample_heun(gaussian_denoiser, noise, sigmas, generator=seeded())
        errors.append((sample - end).abs().max().item())
    ratios = [coarse / fine for coarse, fine in zip(errors[:-1], errors[1:], strict=True)]
    assert errors[-1] < 2e-3 and all(3.7 < ratio < 4.7 for ratio in ratios)  # order 2


def test_churn_keeps_the_distribution_and_needs_the_generator():
    noise, sigmas = torch.randn(20_000, generator=seeded()), karras.karras_sigmas(64, 120)
    first, again, other = (
        karras.sample_heun(gaussian_denoiser, noise, sigmas, churn=3.0, generator=seeded(seed))
        for seed in (1, 1, 2)
    )
    found = first.mean().item(), first.std().item()
    assert found == pytest.approx((MEAN, SPREAD), abs=0.02)  # 5 sigma of 20,000
    assert torch.equal(first, again) and not torch.allclose(first, other)


def test_a_network_of_timesteps_gives_the_exact_denoiser():
    """A network that predicts the noise of normal data gives the exact denoiser at the noise level
    of each integer timestep.
    """
    alphas_cumprod = karras.cosine_alphas_cumprod()

    def network(z, timesteps):
        level = float(alphas_cumprod[timesteps[0]])
        sigma = math.sqrt((1 - level) / level)
        x = z * math.sqrt(sigma**2 + 1)
        return (x - gaussian_denoiser(x, sigma)) / sigma

    denoise = karras.guided_denoiser(network, alphas_cumprod, prediction="epsilon")
    for timestep in (0, 10, 500, 900):
        sigma = math.sqrt(1 / alphas_cumprod[timestep] - 1) * (1 + 1e-9)  # safe from rounding
        x = torch.linspace(-0.4, 0.4, 9, dtype=torch.float64) * math.hypot(1, sigma)
        wanted = gaussian_denoiser(x, sigma).clamp(-1, 1)
        torch.testing.assert_close(denoise(x, sigma), wanted, atol=1e-6, rtol=0)


def test_schedules_and_timesteps():
    """The end points given by the formulas."""
    cosine, linear = karras.cosine_alphas_cumprod(), karras.linear_alphas_cumprod()
    for levels in (cosine, linear):
        assert len(levels) == 1024 and (np.diff(levels) < 0).all()
    assert cosine[511] == pytest.approx(0.494, abs=0.005)  # cos^2 near 45 degrees
    assert 0 < cosine[-1] < 1e-8  # the cap
    assert linear[0] == pytest.approx(1 - 1e-4 * 1000 / 1024)
    assert linear[-1] == pytest.approx(4.0e-5, rel=0.05)
    between = 0.3 * linear[100] + 0.7 * linear[101]
    assert karras.timestep_of(math.sqrt(1 / between - 1), linear) == 100
    assert karras.timestep_of(1e-6, linear) == 0 and karras.timestep_of(1e6, linear) == 1023


def test_guidance_clamps_before_it_combines_and_none_asks_once():
    def network(z, timesteps):
        assert len(z) == 2 and torch.equal(z[0], z[1])
        return torch.stack([torch.full_like(z[0], 4.0), torch.full_like(z[0], -0.5)])

    levels = np.linspace(0.99, 0.01, 20)
    denoise = karras.guided_denoiser(network, levels, scale=3.0, prediction="sample")
    assert denoise(torch.zeros(1, 5), 1.0).unique().tolist() == [-0.5 + 3 * (1 - -0.5)]
    seen = []
    alone = karras.guided_denoiser(lambda z, t: seen.append(len(z)) or z, levels)
    alone(torch.zeros(1, 5), 1.0)
    assert seen == [1]

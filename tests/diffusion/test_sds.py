"""Diffusion by its formulas: schedules, samplers, the optimal denoiser of known images, latents."""

import math
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.diffusion import exact_score, sds

ABAR = sds.sd_alphas_cumprod()
SIGMA = torch.tensor([0.002, 0.3, 0.6, 0.95, 0.999], dtype=torch.float64)


def randn(*shape, seed=0, dtype=torch.float64):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def denoised(z, abar, bank, log_prior=None):
    """Return the predicted noise and the perplexity for a bank in a tensor."""
    distances, weighted = exact_score.squared_distances(z, bank, abar), exact_score.weighted_sum
    return exact_score.denoise(z, abar, distances, partial(weighted, bank=bank), log_prior)


def test_the_schedule_is_stable_diffusions_and_predictions_are_converted_to_the_noise():
    assert ABAR.dtype == torch.float64 and len(ABAR) == 1000
    # Published figures of the scaled-linear schedule: sigma_0 = .029, sqrt(abar/(1-abar)) = 7.2 at
    # t = 20 and .077 at 980.
    assert math.isclose((1 - ABAR[0]).sqrt(), 0.0292, abs_tol=1e-4)
    ratio = (ABAR / (1 - ABAR)).sqrt()
    assert math.isclose(ratio[20], 7.2, abs_tol=0.05)
    assert math.isclose(ratio[980], 0.077, abs_tol=5e-4)
    x, eps = randn(2, 3, 5)
    abar = ABAR[torch.tensor([20, 500, 980])]
    a, sigma = abar.sqrt()[:, None], (1 - abar).sqrt()[:, None]
    outputs = {"epsilon": eps, "v_prediction": a * eps - sigma * x, "sample": x}
    outputs["velocity"] = eps - x
    assert outputs.keys() == sds.PREDICTIONS.keys()
    for name, output in outputs.items():
        found = sds.PREDICTIONS[name](output, a * x + sigma * eps, abar)
        assert_close(found, eps, rtol=0, atol=1e-12)


def test_timesteps_cover_the_valid_range_and_stratified_ones_lie_one_in_each_part():
    cases = [(0.02, 0.98, 20, 980), (0.0, 1.0, 1, 999), (1.0, 1.0, 999, 999), (0.02, 0.55, 20, 550)]
    for low, high, first, last in cases:
        assert sds.step_range(low, high) == (first, last)
    refused("min_step_percent: 0.5 is above", sds.step_range, 0.5, 0.4)
    for low, high, last in ((20, 27, 27), (0, 10, 4)):
        options = {"seed": 0, "num_train": 1000 if low else 5}
        draws = torch.cat([sds.timesteps(8, low, high, step=step, **options) for step in range(99)])
        assert set(draws.tolist()) == set(range(max(low, 1), last + 1))
    rng, batch = torch.Generator().manual_seed(3), 7
    draws = torch.stack([sds.stratified_timesteps(batch, 1000, rng) for _ in range(200)])
    low, high = torch.arange(batch) * 1000 // batch, (torch.arange(batch) + 1) * 1000 / batch
    ordered = draws.sort(1).values
    assert (ordered >= low).all() and (ordered <= high).all()
    assert draws.min() < 20 and draws.max() > 980 and (draws[:, 0] != draws[0, 0]).any()


def test_weights_guidance_loss_and_ddim_by_their_formulas():
    quarter = torch.tensor([0.25], dtype=torch.float64)
    for name, value in {"sds": 0.75, "uniform": 1.0, "fantasia3d": 0.375}.items():
        assert sds.WEIGHTS[name](quarter).item() == value
    cond, uncond = torch.tensor([2.0]), torch.tensor([1.0])
    for scale, expected in ((1.0, cond), (0.0, uncond), (101.0, cond + 100 * (cond - uncond))):
        assert sds.classifier_free(cond, uncond, scale) == expected  # threestudio's 100 is 101
    x, grad = torch.randn(2, 4, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    loss = sds.sds_loss(x.requires_grad_(), grad)
    (found,) = torch.autograd.grad(loss, x)
    assert_close(found, grad / 4)
    assert_close(loss.detach(), 0.5 * grad.square().sum() / 4)
    point = randn(1, 5)

    def predict(z, t):
        abar = ABAR[t]
        return (z - sds.per_item(abar.sqrt(), z) * point) / sds.per_item((1 - abar).sqrt(), z)

    z = randn(3, 5, seed=1)
    for steps in (1, 7, 50):
        out = sds.ddim_sample(predict, z, torch.tensor([3, 500, 980]), ABAR, steps=steps)
        assert_close(out, point.expand(3, 5), rtol=0, atol=1e-11)


def test_a_noisy_latent_lies_on_the_straight_path_of_diffusers_sigmas():
    x, eps = randn(2, 5, 7)
    abar = sds.abar_of_sigma(SIGMA)
    assert_close(sds.sigma_of_abar(abar), SIGMA)
    assert_close(((1 - abar) / abar).sqrt(), SIGMA / (1 - SIGMA))
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
    assert sds.abar_of_sigma(ends).tolist() == [1.0, 0.0]
    assert sds.sigma_of_abar(1 - ends).tolist() == [0.0, 1.0]
    z = sds.diffuse(x, eps, abar)
    path = (1 - SIGMA)[:, None] * x + SIGMA[:, None] * eps
    assert_close(sds.on_path(z, abar), path)
    assert_close(sds.noise_of_velocity(eps - x, z, abar), eps)
    x, eps, guess = randn(3, 5, 7)
    abar = sds.abar_of_sigma(SIGMA)
    z = sds.diffuse(x, eps, abar)
    assert_close(sds.predict_x0(z, eps, abar), x)
    grad = sds.per_item(sds.WEIGHTS["x0"](abar), eps) * (guess - eps)
    assert_close(grad, x - sds.predict_x0(z, guess, abar), rtol=1e-9, atol=1e-9)
    scheduler = pytest.importorskip("diffusers").FlowMatchEulerDiscreteScheduler(shift=3.0)
    sigmas = sds.shifted_sigmas(1000, 3.0)
    # theirs are in decreasing order and end at timestep 1
    assert_close(scheduler.sigmas.flip(0)[:-1].double(), sigmas[1:], rtol=1e-6, atol=0)
    assert sigmas[0] == 0 and (sigmas.diff() > 0).all()


@pytest.mark.parametrize("sigma", [0.05, 0.5, 0.95])
def test_a_mixtures_velocity_is_its_score(sigma):
    """The velocity's posterior, in the flow's own variables, against the exact score."""
    centers, shares = randn(4, 3), torch.tensor([0.1, 0.2, 0.3, 0.4]).double()
    level = torch.tensor([sigma], dtype=torch.float64)
    abar = sds.abar_of_sigma(level)
    z = randn(1, 3, seed=1)
    eps, _ = denoised(z, abar, centers, shares.log()[None])
    on_path = sds.on_path(z, abar)
    gaps = (on_path - (1 - sigma) * centers).square().sum(1)
    x0 = torch.softmax(shares.log() - gaps / (2 * sigma**2), 0) @ centers
    found = sds.noise_of_velocity((on_path - x0) / sigma, z, abar)  # E[eps - x | z]
    assert_close(found, eps, rtol=1e-9, atol=1e-9)


def log_density(z, abar, bank, log_prior):
    """Compute log p_t(z) up to a constant."""
    distances = (z[:, None] - abar.sqrt()[:, None, None] * bank).square().sum(-1)
    return (log_prior - distances / (2 * (1 - abar)[:, None])).logsumexp(1)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 6), st.integers(1, 8), st.integers(0, 999), st.integers(0, 10**6))
def test_eps_is_the_score_of_the_density(modes, dims, t, seed):
    """eps_hat = -sigma grad log p_t, against autograd, to 1e-10 relative to the gradient's size."""
    bank, z = randn(modes, dims, seed=seed), randn(3, dims, seed=seed + 1).requires_grad_()
    abar, log_prior = ABAR[t].expand(3), randn(modes, seed=seed + 2)
    (score,) = torch.autograd.grad(log_density(z, abar, bank, log_prior).sum(), z)
    eps, perplexity = denoised(z.detach(), abar, bank, log_prior)
    expected = -(1 - abar).sqrt()[:, None] * score
    atol = 1e-10 * (1 + expected.abs().max().item())
    assert_close(eps, expected, rtol=1e-10, atol=atol)
    assert (perplexity >= 1 - 1e-9).all() and (perplexity <= modes + 1e-9).all()


def test_the_perplexity_counts_the_modes_and_items_are_independent():
    z, bank, abar = 1e4 * randn(3, 6), randn(7, 6, seed=1), ABAR[torch.tensor([0, 400, 999])]
    assert torch.isfinite(denoised(z, abar, bank)[0]).all()
    corners = torch.eye(4, dtype=torch.float64)
    for z, t, modes in ((torch.zeros_like(corners[:1]), 500, 4), (1e3 * corners[:1], 0, 1)):
        assert math.isclose(denoised(z, ABAR[t : t + 1], corners)[1], modes, abs_tol=1e-12)
    z, abar, own = randn(3, 12), ABAR[torch.tensor([5, 400, 950])], randn(3, 4, 12, seed=1)
    log_prior = randn(3, 4, seed=2)
    for bank in (own, own[0]):
        together = denoised(z, abar, bank, log_prior)
        for i in range(3):
            part = bank[i : i + 1] if bank.dim() == 3 else bank
            alone = denoised(z[i : i + 1], abar[i : i + 1], part, log_prior[i : i + 1])
            for whole, single in zip(together, alone, strict=True):
                # matrix products of different shapes may sum in another order
                assert_close(whole[i : i + 1], single, rtol=0, atol=1e-12)
    excluded = torch.tensor([0.0, 0.0, -torch.inf, -torch.inf])
    expected = denoised(z, abar, own[:, :2])[0]
    assert_close(denoised(z, abar, own, excluded)[0], expected, rtol=0, atol=1e-12)


def test_logits_in_float32_at_512_are_stable_and_those_of_chunks_the_same(monkeypatch):
    """Nearly equal, so that they cancel: within 0.01 nat of those of differences."""
    size, abar = 3 * 512 * 512, ABAR[20:21]
    bank = torch.rand(2, size, generator=torch.Generator().manual_seed(0)) * 2 - 1
    bank[1] = bank[0] + 1e-3 * randn(size, seed=1, dtype=torch.float32)
    z = sds.diffuse(bank[:1], randn(1, size, seed=2, dtype=torch.float32), abar)
    exact = (z.double() - abar.sqrt() * bank.double()).square().sum(-1)
    found = exact_score.squared_distances(z, bank, abar)[0]
    gaps = [float(values[0] - values[1]) / float(2 * (1 - abar)) for values in (found, exact)]
    assert abs(gaps[0] - gaps[1]) < 0.01
    z, bank, abar = randn(2, 30), randn(11, 30, seed=1), ABAR[torch.tensor([50, 700])]
    whole = exact_score.squared_distances(z, bank, abar)
    monkeypatch.setattr("threestudio_gaussiandreamer.diffusion.exact_score.CPU_CHUNK_ELEMENTS", 150)
    assert_close(exact_score.squared_distances(z, bank, abar), whole, rtol=1e-15, atol=0)


@pytest.mark.parametrize("matrix", [None, exact_score.COLOR_MATRIX], ids=["pixels", "colours"])
def test_decode_inverts_encode_on_what_the_latent_holds(matrix):
    pooled = torch.rand(20, 3, 4, 4, generator=torch.Generator().manual_seed(0)) * 0.1 + 0.3
    latent = exact_score.LinearLatent(4, matrix).normalised(pooled)
    rgb = pooled.repeat_interleave(4, 2).repeat_interleave(4, 3)
    latents = latent.encode(rgb)
    assert latents.shape == (20, 3 if matrix is None else 4, 4, 4)
    assert math.isclose(latents.std(), 1, rel_tol=1e-4)
    # float32 through a pseudo-inverse
    assert_close(latent.decode(latents), rgb, rtol=0, atol=1e-5)
    refused("all of one colour", latent.normalised, torch.full((2, 3, 4, 4), 0.5))
    assert torch.equal(exact_score.COLOR_MATRIX.T @ exact_score.COLOR_MATRIX, torch.eye(3))

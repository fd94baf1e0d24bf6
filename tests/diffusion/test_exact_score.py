"""The optimal denoiser of known images, and the linear latent."""

import math
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.diffusion import sds
from threestudio_gaussiandreamer.diffusion.exact_score import (
    COLOR_MATRIX,
    LinearLatent,
    denoise,
    squared_distances,
    weighted_sum,
)

ABAR = sds.sd_alphas_cumprod()


def randn(*shape, seed=0, dtype=torch.float64):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def denoised(z, abar, bank, log_prior=None):
    """Return the predicted noise and the perplexity for a bank in a tensor."""
    distances = squared_distances(z, bank, abar)
    return denoise(z, abar, distances, partial(weighted_sum, bank=bank), log_prior)


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
    torch.testing.assert_close(eps, expected, rtol=1e-10, atol=atol)
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
                torch.testing.assert_close(whole[i : i + 1], single, rtol=0, atol=1e-12)
    excluded = torch.tensor([0.0, 0.0, -torch.inf, -torch.inf])
    expected = denoised(z, abar, own[:, :2])[0]
    torch.testing.assert_close(denoised(z, abar, own, excluded)[0], expected, rtol=0, atol=1e-12)


def test_logits_in_float32_at_512_are_stable_and_those_of_chunks_the_same(monkeypatch):
    """Nearly equal, so that they cancel: within 0.01 nat of those of differences."""
    size, abar = 3 * 512 * 512, ABAR[20:21]
    bank = torch.rand(2, size, generator=torch.Generator().manual_seed(0)) * 2 - 1
    bank[1] = bank[0] + 1e-3 * randn(size, seed=1, dtype=torch.float32)
    z = sds.diffuse(bank[:1], randn(1, size, seed=2, dtype=torch.float32), abar)
    exact = (z.double() - abar.sqrt() * bank.double()).square().sum(-1)
    found = squared_distances(z, bank, abar)[0]
    gaps = [float(values[0] - values[1]) / float(2 * (1 - abar)) for values in (found, exact)]
    assert abs(gaps[0] - gaps[1]) < 0.01
    z, bank, abar = randn(2, 30), randn(11, 30, seed=1), ABAR[torch.tensor([50, 700])]
    whole = squared_distances(z, bank, abar)
    monkeypatch.setattr("threestudio_gaussiandreamer.diffusion.exact_score.CPU_CHUNK_ELEMENTS", 150)
    torch.testing.assert_close(squared_distances(z, bank, abar), whole, rtol=1e-15, atol=0)


@pytest.mark.parametrize("matrix", [None, COLOR_MATRIX], ids=["pixels", "colours"])
def test_decode_inverts_encode_on_what_the_latent_holds(matrix):
    pooled = torch.rand(20, 3, 4, 4, generator=torch.Generator().manual_seed(0)) * 0.1 + 0.3
    latent = LinearLatent(4, matrix).normalised(pooled)
    rgb = pooled.repeat_interleave(4, 2).repeat_interleave(4, 3)
    latents = latent.encode(rgb)
    assert latents.shape == (20, 3 if matrix is None else 4, 4, 4)
    assert math.isclose(latents.std(), 1, rel_tol=1e-4)
    # float32 through a pseudo-inverse
    torch.testing.assert_close(latent.decode(latents), rgb, rtol=0, atol=1e-5)
    with pytest.raises(UserError, match="all of one colour"):
        latent.normalised(torch.full((2, 3, 4, 4), 0.5))
    assert torch.equal(COLOR_MATRIX.T @ COLOR_MATRIX, torch.eye(3))

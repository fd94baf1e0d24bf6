import math

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
)

ABAR = sds.sd_alphas_cumprod()


def randn(*shape, seed=0, dtype=torch.float64):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def log_density(z, abar, bank, std, log_prior):
    """Compute log p_t(z) up to a constant."""
    variance = abar * std**2 + 1 - abar
    distances = (z[:, None] - abar.sqrt()[:, None, None] * bank).square().sum(-1)
    return (log_prior - distances / (2 * variance[:, None])).logsumexp(1)


@settings(max_examples=30, deadline=None)
@given(
    st.integers(1, 6),
    st.integers(1, 8),
    st.integers(0, 999),
    st.sampled_from([0.0, 0.1, 0.7]),
    st.integers(0, 10**6),
)
def test_eps_is_the_score_of_the_density(modes, dims, t, std, seed):
    """eps_hat = -sigma grad log p_t, against autograd, to 1e-10 relative to the gradient's size."""
    bank, z = randn(modes, dims, seed=seed), randn(3, dims, seed=seed + 1).requires_grad_()
    abar, log_prior = ABAR[t].expand(3), randn(modes, seed=seed + 2)
    (score,) = torch.autograd.grad(log_density(z, abar, bank, std, log_prior).sum(), z)
    out = denoise(z.detach(), abar, bank, std=std, log_prior=log_prior)
    expected = -(1 - abar).sqrt()[:, None] * score
    torch.testing.assert_close(
        out.eps, expected, rtol=1e-10, atol=1e-10 * (1 + expected.abs().max().item())
    )
    mixed = sds.add_noise(out.denoised, out.eps, abar)  # z = a D + sigma eps_hat
    torch.testing.assert_close(mixed, z.detach(), rtol=1e-9, atol=1e-9)


def test_one_sharp_mode_gives_a_weighted_squared_error_without_noise():
    """K = 1, s = 0: eps_hat - eps = (a / sigma) (x - x_1), independent of eps."""
    x, target, noise = randn(3, 4, 50)
    abar = ABAR[torch.tensor([20, 300, 600, 980])]
    eps = denoise(sds.add_noise(x, noise, abar), abar, target[:, None]).eps
    expected = (abar / (1 - abar)).sqrt()[:, None] * (x - target)
    torch.testing.assert_close(eps - noise, expected, rtol=0, atol=1e-6)


def test_responsibilities_are_finite_and_perplexity_counts_the_modes_that_share_z():
    z, bank, abar = 1e4 * randn(3, 6), randn(7, 6, seed=1), ABAR[torch.tensor([0, 400, 999])]
    out = denoise(z, abar, bank)
    ones = torch.ones(3, dtype=torch.float64)
    torch.testing.assert_close(out.responsibilities.sum(1), ones, rtol=0, atol=1e-14)
    assert torch.isfinite(out.eps).all()
    corners = torch.eye(4, dtype=torch.float64)
    for z, t, modes in ((torch.zeros_like(corners[:1]), 500, 4), (1e3 * corners[:1], 0, 1)):
        assert math.isclose(denoise(z, ABAR[t : t + 1], corners).perplexity, modes, abs_tol=1e-12)


def test_ddim_from_noise_lands_on_an_image_of_the_bank():
    bank, z = 3 * randn(6, 40), randn(8, 40, seed=1)
    t = torch.full((8,), 999)
    samples = sds.ddim_sample(lambda z, t: denoise(z, ABAR[t], bank).eps, z, t, ABAR, steps=100)
    nearest = torch.cdist(samples, bank).min(dim=1)
    assert nearest.values.max() < 1e-6
    assert len(nearest.indices.unique()) > 1


def test_classifier_free_guidance_acts_on_the_means():
    """eps_u + s (eps_c - eps_u) is the eps of the mean m_u + s (m_c - m_u) for equal widths."""
    bank, z, abar = randn(6, 10), randn(3, 10, seed=1), ABAR[torch.tensor([100, 500, 800])]
    only_two = torch.tensor([0.0, 0.0] + [-torch.inf] * 4)
    distances = squared_distances(z, bank, abar)
    cond = denoise(z, abar, bank, std=0.3, log_prior=only_two, distances=distances)
    uncond = denoise(z, abar, bank, std=0.3)
    means = [out.responsibilities @ bank for out in (cond, uncond)]
    expected = denoise(z, abar, torch.lerp(means[1], means[0], 7.5)[:, None], std=0.3)
    guided = sds.classifier_free(cond.eps, uncond.eps, 7.5)
    torch.testing.assert_close(guided, expected.eps, rtol=0, atol=1e-11)
    alone = denoise(z, abar, bank[:2], std=0.3)
    torch.testing.assert_close(cond.eps, alone.eps, rtol=0, atol=1e-12)


def test_items_are_independent_with_shared_and_with_separate_banks():
    z, abar, own = randn(3, 12), ABAR[torch.tensor([5, 400, 950])], randn(3, 4, 12, seed=1)
    log_prior = randn(3, 4, seed=2)
    for bank in (own, own[0]):
        together = denoise(z, abar, bank, std=0.2, log_prior=log_prior)
        for i in range(3):
            part = bank[i : i + 1] if bank.dim() == 3 else bank
            alone = denoise(
                z[i : i + 1], abar[i : i + 1], part, std=0.2, log_prior=log_prior[i : i + 1]
            )
            for whole, single in zip(together, alone, strict=True):
                # matrix products of different shapes may sum in another order
                torch.testing.assert_close(whole[i : i + 1], single, rtol=0, atol=1e-12)


def test_distances_in_chunks_are_the_distances(monkeypatch):
    z, bank, abar = randn(2, 30), randn(11, 30, seed=1), ABAR[torch.tensor([50, 700])]
    whole = squared_distances(z, bank, abar)
    monkeypatch.setattr("threestudio_gaussiandreamer.diffusion.exact_score.CPU_CHUNK_ELEMENTS", 150)
    torch.testing.assert_close(squared_distances(z, bank, abar), whole, rtol=1e-15, atol=0)


def test_logits_in_float32_at_512_are_stable():
    """The logits of float32 images, nearly equal so that they cancel, are within 0.01 nat of those
    of differences.
    """
    size, abar = 3 * 512 * 512, ABAR[20:21]
    bank = torch.rand(2, size, generator=torch.Generator().manual_seed(0)) * 2 - 1
    bank[1] = bank[0] + 1e-3 * randn(size, seed=1, dtype=torch.float32)
    z = sds.add_noise(bank[:1], randn(1, size, seed=2, dtype=torch.float32), abar)
    exact = (z.double() - abar.sqrt() * bank.double()).square().sum(-1)
    found = squared_distances(z, bank, abar)[0]
    gaps = [float(values[0] - values[1]) / float(2 * (1 - abar)) for values in (found, exact)]
    assert abs(gaps[0] - gaps[1]) < 0.01


# The linear latent


def test_the_latent_is_linear_and_its_adjoint_exact():
    latent = LinearLatent(4, COLOR_MATRIX, 1.7)
    x, direction, y = (
        randn(2, 3, 16, 8).requires_grad_(),
        randn(2, 3, 16, 8, seed=1),
        randn(2, 4, 4, 2, seed=2),
    )
    latents = latent.encode(x)
    (adjoint,) = torch.autograd.grad((latents * y).sum(), x)
    change = latent.encode(x.detach() + direction) - latents.detach()
    torch.testing.assert_close(
        (adjoint * direction).sum(), (change * y).sum(), rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("matrix", [None, COLOR_MATRIX], ids=["pixels", "colours"])
def test_decode_inverts_encode_on_what_the_latent_holds(matrix):
    pooled = torch.rand(20, 3, 4, 4, generator=torch.Generator().manual_seed(0)) * 0.1 + 0.3
    latent = LinearLatent(4, matrix).normalised(pooled)
    with pytest.raises(UserError, match="all of one colour"):
        latent.normalised(torch.full((2, 3, 4, 4), 0.5))
    rgb = pooled.repeat_interleave(4, 2).repeat_interleave(4, 3)
    latents = latent.encode(rgb)
    assert latents.shape == (20, 3 if matrix is None else 4, 4, 4)
    assert math.isclose(latents.std(), 1, rel_tol=1e-4)
    # float32 through a pseudo-inverse
    torch.testing.assert_close(latent.decode(latents), rgb, rtol=0, atol=1e-5)
    assert torch.equal(COLOR_MATRIX.T @ COLOR_MATRIX, torch.eye(3))

"""Each variant against its closed form, in float64, on a mixture of Gaussians in 3D."""

import pytest
import torch

from tests.helpers.pixel_guidance import (
    MODES,
    MixtureGuidance,
    draws,
    latents,
    mixture_guidance,
    noise_of,
)
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core import streams
from threestudio_gaussiandreamer.diffusion import consistent_noise, inversion
from threestudio_gaussiandreamer.guidance.variants import vsd

EXACT = 1e-10
"""Largest error: only rounding of float64, and the noise, which is drawn in float32, is given."""


def error_of(guidance, x, batch=None):
    with torch.no_grad():
        error, abar = guidance.variant.residual(guidance, x, None, batch or {})
    assert error.dtype == torch.float64 and error.shape == x.shape and abar.shape == (len(x),)
    return error


def assert_close(a, b):
    assert (a - b).abs().max() <= EXACT * b.abs().max()


def both_scores(guidance, z, t):
    abar = guidance.abar_of(t)
    return noise_of(z, abar, MODES[:1]), noise_of(z, abar, MODES)


def rescaled(z, a, sigma, cond, guided, share):
    """eps = (z - a f x0_guided) / sigma, f = share std(x0_cond) / std(x0_guided) + 1 - share."""
    x0_cond, x0_guided = ((z - sigma * eps) / a for eps in (cond, guided))
    deviations = [x0.std(dim=(1, 2, 3), keepdim=True) for x0 in (x0_cond, x0_guided)]
    factor = share * deviations[0] / deviations[1] + 1 - share
    return (z - a * factor * x0_guided) / sigma


@pytest.mark.parametrize(
    ("variant", "scale", "share"),
    [("sds", 1.0, 0), ("sds", 7.5, 0), ("sds", 30.0, 0.5), ("sds", 30.0, 1.0), ("csd", 7.5, 0)]
    + [("vsd", 7.5, 0)],
)
def test_the_residual_of_random_noise(variant, scale, share):
    """That of VSD before any render is that of SDS."""
    options = {"guidance_scale": scale, "recon_std_rescale": share}
    guidance, x = mixture_guidance(f"{variant}-variant", **options), latents()
    t, a, sigma, noise, z = draws(guidance, x)
    cond, uncond = both_scores(guidance, z, t)
    guided = uncond + scale * (cond - uncond)
    if share:
        guided = rescaled(z, a, sigma, cond, guided, share)
    expected = scale * (cond - uncond) if variant == "csd" else guided - noise
    assert_close(error_of(guidance, x), expected)


class Negative(MixtureGuidance):
    """The unconditional score is that of a negative prompt, two of the modes."""

    def empty_prompt(self, z, t, condition):
        return noise_of(z, self.abar_of(t), MODES[1:])


def test_nfsd_with_a_negative_prompt():
    guidance, x = Negative({"variant_type": "nfsd-variant", "guidance_scale": 7.5}), latents(9)
    t, a, sigma, noise, z = draws(guidance, x)
    cond, negative = both_scores(guidance, z, t)
    empty = noise_of(z, guidance.abar_of(t), MODES[1:])
    small = (t < 200).reshape(-1, 1, 1, 1)
    assert small.any() and not small.all()
    expected = torch.where(small, empty, empty - negative) + 7.5 * (cond - empty)
    assert_close(error_of(guidance, x), expected)


def learn(guidance, x):
    guidance.variant.learn(guidance, x, None, {}, torch.ones(len(x), dtype=torch.bool))


def test_vsd_subtracts_the_optimal_denoiser_of_the_renders_gaussian(monkeypatch):
    """With a momentum of 3/4, the renders of two steps have the shares 3/7 and 4/7."""
    monkeypatch.setattr(vsd, "MOMENTUM", 0.75)
    guidance = mixture_guidance("vsd-variant", guidance_scale=7.5)
    first, second = latents(4), latents(6, 1)
    learn(guidance, first)
    learn(guidance, second)
    weights = torch.tensor([3 / 28] * 4 + [4 / 42] * 6, dtype=torch.float64)
    seen = torch.cat([first, second]).reshape(-1, 3)
    mean = weights @ seen
    variance = weights @ (seen - mean) ** 2
    x = latents()
    t, a, sigma, noise, z = draws(guidance, x)
    cond, uncond = both_scores(guidance, z, t)
    own = sigma * (z - a * mean) / (a**2 * variance + sigma**2)
    assert_close(error_of(guidance, x), uncond + 7.5 * (cond - uncond) - own)


def test_sdi_and_ism_follow_their_formulas_step_by_step():
    """By threestudio's formulas on our timesteps; tests/host/test_real_variants.py runs its own."""
    options = {"guidance_scale": 8.5, "weighting_strategy": "x0"}
    guidance, x = mixture_guidance("sdi-variant", step=11, **options), latents(1)
    (t,), _ = guidance.draw_timesteps(x)
    abars = guidance.alphas_cumprod

    def predicted(z, t, scale):
        cond, uncond = both_scores(guidance, z, torch.tensor([t]))
        return cond + scale * (cond - uncond)

    z, table = x, inversion.NoiseTable(0, (1, 1, 3))
    times = [*range(0, int(t), 100), int(t)]
    for index, (now, later) in enumerate(zip(times, times[1:], strict=False)):
        eps = predicted(z, now, -7.5)
        original = (z - (1 - abars[now]) ** 0.5 * eps) / abars[now] ** 0.5
        z = abars[later] ** 0.5 * original + (1 - abars[later]) ** 0.5 * eps
        variance = (1 - abars[now]) / (1 - abars[later]) * (1 - abars[later] / abars[now])
        drawn = table.draw("inversion", 11, 0, 1, part=index)[0]
        z = z + 0.3 * drawn.double() * variance**0.5
    denoised = (z - (1 - abars[t]) ** 0.5 * predicted(z, int(t), 7.5)) / abars[t] ** 0.5
    weight = ((1 - abars[t]) / abars[t]) ** 0.5
    assert_close(weight * error_of(guidance, x), x - denoised)
    guidance, x = mixture_guidance("ism-variant", guidance_scale=7.5), latents(7)
    abars, expected = guidance.alphas_cumprod, []

    def scores(z, t):
        return (score[0] for score in both_scores(guidance, z[None], torch.tensor([t])))

    def step(z, eps, now, later):
        denoised = (z - (1 - abars[now]) ** 0.5 * eps) / abars[now] ** 0.5
        return abars[later] ** 0.5 * denoised + (1 - abars[later]) ** 0.5 * eps

    for z, t in zip(x, guidance.draw_timesteps(x)[0].tolist(), strict=True):
        s = max(t - 50, 0)
        for start in range(0, s, 200):
            _, uncond = scores(z, start)
            z = step(z, uncond, start, min(start + 200, s))
        _, before = scores(z, s)
        cond, uncond = scores(step(z, before, s, t), t)
        expected.append(uncond + 7.5 * (cond - uncond) - before)
    assert_close(error_of(guidance, x), torch.stack(expected))


def test_cfd_uses_the_surfaces_noise():
    guidance, x = mixture_guidance("cfd-variant", guidance_scale=7.5), latents(2)
    batch = {
        "depth": torch.full((2, 4, 12, 1), 2.0),
        "opacity": torch.ones(2, 4, 12, 1),
        "c2w": torch.eye(4).repeat(2, 1, 1),
        "fovy": torch.full((2,), 0.8),
    }
    generator = streams.generator(0, "surface noise")  # the same in each step
    cells = consistent_noise.cell_values(x.shape[1], generator)
    seed = streams.derive_seed(0, "background cells", guidance.step) % consistent_noise.TABLE
    noise = consistent_noise.attached_noise(x.shape[-2:], cells, seed, 0, *batch.values())
    t, a, sigma, *_ = draws(guidance, x)
    z = a * x + sigma * noise
    cond, uncond = both_scores(guidance, z, t)
    assert_close(error_of(guidance, x, batch), uncond + 7.5 * (cond - uncond) - noise)
    refused("cfd-variant needs the renderer's depth and opacity", error_of, guidance, x)
    assert torch.equal(noise[0], noise[1])  # two views from the same place
    assert not torch.equal(noise, guidance.normal(x, "noise"))

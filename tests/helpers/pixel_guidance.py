"""Score distillation on pixels, and from a mixture of Gaussians in 3D, in float64."""

import math

import torch

from threestudio_gaussiandreamer.core import streams
from threestudio_gaussiandreamer.diffusion import sds
from threestudio_gaussiandreamer.guidance.base import ScoreDistillation


class PixelGuidance(ScoreDistillation):
    """Latents are the pixels in [-1, 1], and no prompt is read; subclasses predict the noise."""

    def encode(self, rgb, **batch):
        return 2 * rgb - 1

    def decode(self, latents):
        return (latents + 1) / 2

    def condition(self, prompt_utils, **batch):
        return None


class TowardsGrey(PixelGuidance):
    """The gradient is w x for latents x."""

    def predict(self, z, t, condition):
        noise = streams.normal_per_item(tuple(z.shape), 0, "noise", self.step)
        return noise + sds.predict_x0(z, noise, self.alphas_cumprod[t]), None


MODES = torch.tensor(
    [[0.3, -0.2, 0.5], [-0.6, 0.4, 0.1], [0.2, 0.7, -0.4], [-0.1, -0.5, -0.3]], dtype=torch.float64
)
STD = 0.4


def noise_of(z, abar, modes, std=STD):
    """Return -sigma grad log p_t(z), by autograd, of an equal mixture of N(mode, std^2) after
    noising, for z (B, 1, 1, 3) and abar (B,).
    """
    with torch.enable_grad():
        z = z.detach().requires_grad_()
        abar = abar.reshape(-1, 1)
        variance = abar * std**2 + 1 - abar
        distances = (z.reshape(-1, 1, 3) - abar[..., None].sqrt() * modes).square().sum(-1)
        logs = torch.logsumexp(-distances / (2 * variance), 1) - math.log(len(modes))
        (slope,) = torch.autograd.grad(logs.sum(), z)
    return -(1 - abar).sqrt().reshape(-1, 1, 1, 1) * slope


class MixtureGuidance(PixelGuidance):
    """The conditional mixture has the first ``CONDITIONAL`` modes, the unconditional one all."""

    CONDITIONAL = 1

    def predict(self, z, t, condition):
        abar = self.abar_of(t)
        self.evaluations += len(z) * (2 if self.needs_unconditional else 1)
        uncond = noise_of(z, abar, MODES) if self.needs_unconditional else None
        return noise_of(z, abar, MODES[: self.CONDITIONAL]), uncond


def mixture_guidance(variant_type="sds-variant", step=3, **options):
    """Return the guidance at a step, with timesteps that differ between items."""
    guidance = MixtureGuidance({"variant_type": variant_type, **options})
    guidance.update_step(0, step)
    return guidance


def latents(batch=5, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, 1, 1, 3, generator=generator, dtype=torch.float64)


def draws(guidance, x):
    """Return t, a and sigma (B, 1, 1, 1) of a step, its noise, and the noisy latents of SDS."""
    t, abar = guidance.draw_timesteps(x)
    a, sigma = (value.sqrt().reshape(-1, 1, 1, 1) for value in (abar, 1 - abar))
    noise = guidance.normal(x, "noise").double()
    return t, a, sigma, noise, a * x + sigma * noise

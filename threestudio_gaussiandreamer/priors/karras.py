"""Sampling a diffusion model of 3D data as Point-E and Shap-E were sampled: Karras noise levels,
Heun steps, guidance.

The networks were trained with discrete timesteps of a variance-preserving process, ``z_t =
sqrt(abar_t) x0 + sqrt(1 - abar_t) eps``; the sampler works on ``x = x0 + sigma eps``, which equals
``z_t / sqrt(abar_t)`` at ``sigma^2 = (1 - abar_t) / abar_t``. Implemented from Algorithm 2 of
Karras et al. 2022, "Elucidating the design space of diffusion-based generative models", with the
conventions of the published samplers (openai/point-e, openai/shap-e, MIT)."""

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

Denoiser = Callable[[Tensor, float], Tensor]
"""Maps (x, sigma) to the estimate of x0, of the same shape."""
Network = Callable[[Tensor, Tensor], Tensor]
"""Maps (z (N, ...), timesteps (N,)) to the network's prediction, of the same shape as z."""

RHO = 7.0


def karras_sigmas(steps: int, sigma_min: float, sigma_max: float) -> list[float]:
    """Return ``steps`` noise levels from ``sigma_max`` to ``sigma_min``, then 0; evenly spaced in
    ``sigma^(1/7)`` (eq. 5).
    """
    high, low = sigma_max ** (1 / RHO), sigma_min ** (1 / RHO)
    return [float((high + t * (low - high)) ** RHO) for t in np.linspace(0, 1, steps)] + [0.0]


def cosine_alphas_cumprod(steps: int = 1024) -> Float[np.ndarray, "T"]:
    """Return abar of the cosine schedule (Nichol and Dhariwal 2021, eq. 17), with betas clipped to
    0.999.
    """
    curve = np.cos((np.arange(steps + 1) / steps + 0.008) / 1.008 * np.pi / 2) ** 2
    return np.cumprod(1 - np.minimum(1 - curve[1:] / curve[:-1], 0.999))


def linear_alphas_cumprod(steps: int = 1024) -> Float[np.ndarray, "T"]:
    """Return abar of the linear schedule (Ho et al. 2020), rescaled from 1000 to ``steps``
    timesteps.
    """
    return np.cumprod(1 - np.linspace(0.1 / steps, 20 / steps, steps))


def timestep_of(sigma: float, alphas_cumprod: Float[np.ndarray, "T"]) -> int:
    """Return the largest timestep whose noise level is at most ``sigma``, or 0.

    The fractional timestep is interpolated linearly in abar and truncated.
    """
    level = 1 / (sigma**2 + 1)
    # np.interp requires increasing values
    return int(np.interp(-level, -alphas_cumprod, np.arange(len(alphas_cumprod))))


def guided_denoiser(
    network: Network,
    alphas_cumprod: Float[np.ndarray, "T"],
    *,
    scale: float = 1.0,
    prediction: Literal["sample", "epsilon"] = "epsilon",
) -> Denoiser:
    """Return a denoiser from a network of discrete timesteps.

    Args:
        network: if ``scale`` isn't 1, its batch has each item twice, first with the prompt, then
            without.
        scale: 1 for no guidance; else ``x0 = x0_none + scale (x0_prompt - x0_none)``. As in the
            published samplers, each estimate is clamped to [-1, 1] before they are combined, and
            the result isn't clamped.
        prediction: whether the network predicts x0 or the noise.
    """

    def estimate(x: Tensor, sigma: float) -> Tensor:
        timestep = timestep_of(sigma, alphas_cumprod)
        z = x / math.sqrt(sigma**2 + 1)
        z = z if scale == 1 else torch.cat([z, z])
        output = network(z, torch.full((len(z),), timestep, device=z.device)).to(z.dtype)
        if prediction == "epsilon":
            level = float(alphas_cumprod[timestep])
            output = (z - math.sqrt(1 - level) * output) / math.sqrt(level)
        x0 = output.clamp(-1, 1)
        if scale == 1:
            return x0
        prompted, unprompted = x0.chunk(2)
        return unprompted + scale * (prompted - unprompted)

    return estimate


@torch.no_grad()
def sample_heun(
    denoise: Denoiser,
    noise: Tensor,
    sigmas: list[float],
    *,
    churn: float = 0.0,
    generator: torch.Generator,
    progress: str = "",
) -> Tensor:
    """Run Karras et al.'s Algorithm 2: second-order steps from pure noise to a sample.

    Args:
        noise: standard normal, of the sample's shape and on its device.
        sigmas: decreasing noise levels that end with 0 (:func:`karras_sigmas`).
        churn: the paper's S_churn, the amount of noise that is added at each step; 0 makes the
            sampler deterministic.
        generator: a CPU generator for that noise.
        progress: title of a progress bar on terminals; if empty, there is no bar.
    """
    from tqdm import tqdm

    gamma = min(churn / (len(sigmas) - 1), math.sqrt(2) - 1)
    x = noise * sigmas[0]
    steps = list(zip(sigmas[:-1], sigmas[1:], strict=True))
    for sigma, sigma_next in tqdm(steps, progress, disable=None if progress else True, leave=False):
        sigma_hat = sigma * (1 + gamma)
        if gamma > 0:
            fresh = torch.randn(x.shape, generator=generator).to(x)
            x = x + fresh * math.sqrt(sigma_hat**2 - sigma**2)
        slope = (x - denoise(x, sigma_hat)) / sigma_hat
        euler = x + (sigma_next - sigma_hat) * slope
        if sigma_next == 0:
            return euler
        slope_there = (euler - denoise(euler, sigma_next)) / sigma_next
        x = x + (sigma_next - sigma_hat) * (slope + slope_there) / 2
    return x

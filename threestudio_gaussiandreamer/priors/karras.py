"""What Point-E and Shap-E have in common: their sampler, with Karras noise levels, Heun steps and
guidance, the condition and the place of their results.

===================  ===============================================================================
option               meaning (of ``point-e-prior`` and ``shap-e-prior``)
===================  ===============================================================================
prompt               asked of the model in place of the run's prompt
guidance_scale       1 = none
scale                world units for one of the model's; 1.6 in the paper's code
front                the axis of the model's space that looks at azimuth 0; z is up
===================  ===============================================================================

The networks were trained with discrete timesteps of a variance-preserving process, ``z_t =
sqrt(abar_t) x0 + sqrt(1 - abar_t) eps``; the sampler works on ``x = x0 + sigma eps``, which equals
``z_t / sqrt(abar_t)`` at ``sigma^2 = (1 - abar_t) / abar_t``. Implemented from Algorithm 2 of
Karras et al. 2022, with the conventions of the published samplers (openai/point-e, MIT)."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, Optional

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..core.options import one_of, positive
from ..gaussians.point_cloud import PointCloud
from ..meshes.load import AXES
from ..models.clip import load_text_encoder, load_tokenizer, text_condition
from ..models.model_files import loaded
from .base import SCALE, Prior

Denoiser = Callable[[Tensor, float], Tensor]
"""Maps (x, sigma) to the estimate of x0, of the same shape."""
Network = Callable[[Tensor, Tensor], Tensor]
"""Maps (z (N, ...), timesteps (N,)) to the network's prediction, of the same shape as z."""

RHO, SIGMA_MIN = 7.0, 1e-3


class SampledPrior(Prior):
    """Base class of priors that sample a diffusion model of 3D data."""

    @dataclass
    class Config(Prior.Config):
        prompt: Optional[str] = None
        guidance_scale: float = field(default=3.0, metadata=positive())
        scale: float = field(default=1.6, metadata=SCALE)
        front: str = field(default="-y", metadata=one_of(("+x", "-x", "+y", "-y")))
        REMOVED: ClassVar[dict[str, Any]] = {
            **Prior.Config.REMOVED,
            "sigma_min": (SIGMA_MIN, f"it is {SIGMA_MIN:g}"),
            "normalize": (False, "scale is in units of the model"),
            "device": ("auto", "it is the run's device"),
        }

    cfg: Config

    def placed(self, cloud: PointCloud) -> PointCloud:
        """Return ``cloud``, which has z up, rotated so that ``front`` becomes +x, and scaled."""
        front = AXES[self.cfg.front]
        turn = np.stack([front, np.cross(AXES["+z"], front), AXES["+z"]])
        points = self.cfg.scale * (np.asarray(cloud.points, np.float64) @ turn.T)
        return cloud._replace(points=points.astype(np.float32))

    def condition(
        self, name: str, folder: Path, prompt: str, parts: tuple[str, str] = ("", ""), **how: Any
    ) -> Float[Tensor, "N D"]:
        """Return the prompt's features by the text encoder and tokenizer of a model, in these
        ``parts`` below ``folder``, and with guidance the unconditional ones, zeros, in a second
        row; ``how`` is for ``load_text_encoder``.
        """
        network = loaded(
            (f"{name} text_encoder", str(folder), self.device, *how.values()),
            lambda: load_text_encoder(folder, parts[0], **how).to(self.device),
        )
        key = (f"{name} tokenizer", str(folder))
        tokens = loaded(key, lambda: load_tokenizer(folder, parts[1]))
        found = text_condition(tokens, network, self.cfg.prompt or prompt)
        none = [] if self.cfg.guidance_scale == 1 else [torch.zeros_like(found)]
        return torch.cat([found, *none])


def torch_generator(generator: np.random.Generator) -> torch.Generator:
    """Return a CPU generator of torch whose seed is drawn from ``generator``."""
    return torch.Generator().manual_seed(int(generator.integers(2**62)))


def karras_sigmas(steps: int, sigma_max: float, sigma_min: float = SIGMA_MIN) -> list[float]:
    """Return ``steps`` noise levels, evenly spaced in ``sigma^(1/7)`` (eq. 5), and 0."""
    high, low = sigma_max ** (1 / RHO), sigma_min ** (1 / RHO)
    return [float((high + t * (low - high)) ** RHO) for t in np.linspace(0, 1, steps)] + [0.0]


def cosine_alphas_cumprod(steps: int = 1024) -> Float[np.ndarray, "T"]:
    """Return abar of the cosine schedule (Nichol and Dhariwal 2021, eq. 17), betas up to 0.999."""
    curve = np.cos((np.arange(steps + 1) / steps + 0.008) / 1.008 * np.pi / 2) ** 2
    return np.cumprod(1 - np.minimum(1 - curve[1:] / curve[:-1], 0.999))


def linear_alphas_cumprod(steps: int = 1024) -> Float[np.ndarray, "T"]:
    """Return abar of the linear schedule (Ho et al. 2020), rescaled from 1000 timesteps."""
    return np.cumprod(1 - np.linspace(0.1 / steps, 20 / steps, steps))


def timestep_of(sigma: float, alphas_cumprod: Float[np.ndarray, "T"]) -> int:
    """Return the last timestep with noise of at most ``sigma``, or 0; abar is interpolated."""
    levels = -alphas_cumprod  # np.interp requires increasing values
    return int(np.interp(-1 / (sigma**2 + 1), levels, np.arange(len(levels))))


def guided_denoiser(
    network: Network,
    alphas_cumprod: Float[np.ndarray, "T"],
    *,
    scale: float = 1.0,
    prediction: Literal["sample", "epsilon"] = "epsilon",
) -> Denoiser:
    """Return a denoiser from a network of discrete timesteps.

    Args:
        network: if ``scale`` isn't 1, its batch has all items with the prompt, then without.
        scale: 1 for no guidance; else ``x0 = x0_none + scale (x0_prompt - x0_none)``. As in the
            published samplers, the estimates are clamped to [-1, 1], the result isn't.
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
        churn: the paper's S_churn, the amount of noise that is added at each step.
        generator: a CPU generator for that noise.
        progress: title of a progress bar on terminals.
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

"""Score distillation sampling as plain formulas: schedule, noising, guidance with Perp-Neg and
rescaling, weights, loss, and conversions of a network's output.

Notation of DDPM (Ho et al. 2020): ``abar`` is the cumulative product of 1 - beta, and

    z = sqrt(abar) x + sqrt(1 - abar) eps.

``abar`` is given per item, (B,), usually in float64; its square roots are converted to z's type.

A rectified flow (Liu et al. 2023; Esser et al. 2024, eq. 13) is trained on the straight path

    z_sigma = (1 - sigma) x + sigma eps,    v = eps - x,    0 <= sigma <= 1.

Divided by sqrt((1 - sigma)^2 + sigma^2) this is z with abar = (1 - sigma)^2 / ((1 - sigma)^2 +
sigma^2), the same picture and noise, so every formula on noise predictions also applies to a flow.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..core import streams
from ..core.errors import UserError
from ..core.tensors import given_gradient

WEIGHTS: dict[str, Callable[[Tensor], Tensor]] = {
    "sds": lambda abar: 1 - abar,
    "uniform": torch.ones_like,
    "fantasia3d": lambda abar: abar.sqrt() * (1 - abar),
    "x0": lambda abar: ((1 - abar) / abar).sqrt(),
    "rectified_flow": lambda abar: 1 + ((1 - abar) / abar).sqrt(),
}
"""The weights w(t): sigma_t^2 of DreamFusion (Poole et al. 2022), 1, a_t sigma_t^2 of Fantasia3D
(Chen et al. 2023), sigma_t / a_t, with which the gradient is x minus the denoised x, and 1 plus
that, with which it is the error of a rectified flow's velocity; a_t = sqrt(abar) and sigma_t^2 =
1 - abar.
"""


def per_item(values: Float[Tensor, " B"], like: Tensor) -> Tensor:
    """Reshape (B,) to (B, 1, ..., 1) in the type and on the device of ``like``."""
    return values.to(like).reshape(-1, *[1] * (like.dim() - 1))


def sd_alphas_cumprod(
    num_train: int = 1000, *, beta_start: float = 0.00085, beta_end: float = 0.012
) -> Float[Tensor, " T"]:
    """Return Stable Diffusion's abar, float64: sqrt(beta) is linear in t ("scaled linear")."""
    betas = torch.linspace(beta_start**0.5, beta_end**0.5, num_train, dtype=torch.float64) ** 2
    return torch.cumprod(1 - betas, dim=0)


def step_range(min_percent: float, max_percent: float, num_train: int = 1000) -> tuple[int, int]:
    """Convert a range in fractions of ``num_train``, in [0, 1], to its first and last timestep,
    both clamped to [1, num_train - 1].

    Raises:
        UserError: the minimum is above the maximum.
    """
    if min_percent > max_percent:
        raise UserError(
            f"min_step_percent: {min_percent} is above max_step_percent, {max_percent}: if they "
            "are schedules, the minimum must not exceed the maximum at any step"
        )
    low, high = (
        min(max(int(num_train * percent), 1), num_train - 1)
        for percent in (min_percent, max_percent)
    )
    return low, high


def timesteps(
    batch: int,
    min_step: int,
    max_step: int,
    *,
    seed: int,
    step: int,
    num_train: int = 1000,
    stream: str = "timestep",
    first: int = 0,
) -> Int[Tensor, " B"]:
    """Draw one timestep per item, uniform on [min_step, max_step] clamped to [1, num_train - 1].

    Each item, numbered from ``first``, has its own random stream, independent of ``batch``.
    """
    low, high = (min(max(value, 1), num_train - 1) for value in (min_step, max_step))
    draws = [
        torch.randint(low, high + 1, (), generator=streams.generator(seed, stream, step, item))
        for item in range(first, first + batch)
    ]
    return torch.stack(draws) if draws else torch.empty(0, dtype=torch.long)


def stratified_timesteps(batch: int, num_train: int, rng: torch.Generator) -> Int[Tensor, " B"]:
    """Draw a timestep in each of ``batch`` equal ranges of [0, num_train - 1], in random order."""
    fractions = (torch.randperm(batch, generator=rng) + torch.rand(batch, generator=rng)) / batch
    return (fractions * num_train).long().clamp(max=num_train - 1)


def diffuse(
    x: Float[Tensor, "B *d"], noise: Float[Tensor, "B *d"], abar: Float[Tensor, " B"]
) -> Float[Tensor, "B *d"]:
    """Compute z = sqrt(abar) x + sqrt(1 - abar) eps (DDPM eq. 4)."""
    return per_item(abar.sqrt(), x) * x + per_item((1 - abar).sqrt(), x) * noise


def predict_x0(
    z: Float[Tensor, "B *d"], eps: Float[Tensor, "B *d"], abar: Float[Tensor, " B"]
) -> Float[Tensor, "B *d"]:
    """Compute x0 = (z - sqrt(1 - abar) eps) / sqrt(abar), the inverse of :func:`diffuse`."""
    return (z - per_item((1 - abar).sqrt(), z) * eps) / per_item(abar.sqrt(), z)


def classifier_free(
    eps_cond: Float[Tensor, "B *d"], eps_uncond: Float[Tensor, "B *d"], scale: float
) -> Float[Tensor, "B *d"]:
    """Compute eps_u + scale (eps_c - eps_u), a scale of 1 being none (Ho and Salimans 2022: 1 + w).

    threestudio's formula is eps_c + g (eps_c - eps_u): its g = 100 is scale = 101 here.
    """
    return torch.lerp(eps_uncond, eps_cond, scale)


def sds_loss(x: Float[Tensor, "B *d"], grad: Float[Tensor, "B *d"]) -> Float[Tensor, ""]:
    """Compute 0.5 sum grad^2 / B, a loss whose gradient with respect to x is grad / B.

    This is threestudio's 0.5 sum |x - stop(x - grad)|^2 / B without the rounding of x - grad.
    """
    grad, items = grad.detach(), max(len(grad), 1)
    return given_gradient(x, grad * (1 / items), 0.5 * grad.square().sum() / items)


def ddim_step(
    z: Float[Tensor, "B *d"],
    eps: Float[Tensor, "B *d"],
    abar: Float[Tensor, " B"],
    abar_next: Float[Tensor, " B"],
) -> Float[Tensor, "B *d"]:
    """Take a DDIM step to ``abar_next``, lower or higher (Song et al. 2021 eq. 12 with eta 0)."""
    ratio, slope = ddim_factors(abar, abar_next)
    return per_item(ratio, z) * z + per_item(slope, z) * eps


def ddim_factors(
    abar: Float[Tensor, "*b"], abar_next: Float[Tensor, "*b"]
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Return what :func:`ddim_step` multiplies z and the noise by; arrays give arrays."""
    ratio = (abar_next / abar) ** 0.5
    return ratio, (1 - abar_next) ** 0.5 - ratio * (1 - abar) ** 0.5


def ddim_sample(
    predict: Callable[[Tensor, Tensor], Tensor],
    z: Float[Tensor, "B *d"],
    t: Int[Tensor, " B"],
    alphas_cumprod: Float[Tensor, " T"],
    *,
    steps: int = 20,
) -> Float[Tensor, "B *d"]:
    """Denoise z from each item's timestep ``t`` to x0 in ``steps`` equal steps of DDIM.

    Args:
        predict: returns eps for (z, t); t is (B,).
        alphas_cumprod: abar by timestep; a step to timestep 0 ends at abar = 1 instead.
    """
    for index in range(steps):
        now, later = (
            torch.div(t * (steps - i), steps, rounding_mode="floor") for i in (index, index + 1)
        )
        abar_later = torch.where(
            later > 0, alphas_cumprod[later], torch.ones_like(alphas_cumprod[later])
        )
        z = ddim_step(z, predict(z, now), alphas_cumprod[now], abar_later)
    return z


def abar_of_sigma(sigma: Float[Tensor, " B"]) -> Float[Tensor, " B"]:
    """Return the abar of the diffusion with the same ratio of picture and noise."""
    return (1 - sigma).square() / ((1 - sigma).square() + sigma.square())


def sigma_of_abar(abar: Float[Tensor, " B"]) -> Float[Tensor, " B"]:
    """Return sigma, the inverse of :func:`abar_of_sigma`."""
    return (1 - abar).sqrt() / (abar.sqrt() + (1 - abar).sqrt())


def on_path(z: Float[Tensor, "B *d"], abar: Float[Tensor, " B"]) -> Float[Tensor, "B *d"]:
    """Return the flow's latent of a diffusion's: z_sigma = z / (sqrt(abar) + sqrt(1 - abar))."""
    return z / per_item(abar.sqrt() + (1 - abar).sqrt(), z)


def noise_of_velocity(
    v: Float[Tensor, "B *d"], z: Float[Tensor, "B *d"], abar: Float[Tensor, " B"]
) -> Float[Tensor, "B *d"]:
    """Compute eps = z_sigma + (1 - sigma) v; v = eps - x0, and ``z`` is the diffusion's latent."""
    return on_path(z, abar) + per_item(1 - sigma_of_abar(abar), z) * v


def shifted_sigmas(num_train: int, shift: float) -> Float[Tensor, " T"]:
    """Compute sigma by timestep, increasing from 0 at timestep 0, float64: shift u / (1 + (shift -
    1) u) with u = t / num_train (Esser et al. 2024, eq. 23); a ``shift`` above 1 puts more
    timesteps at high noise, as large pictures need.
    """
    u = torch.arange(num_train, dtype=torch.float64) / num_train
    return shift * u / (1 + (shift - 1) * u)


PREDICTIONS = {
    "epsilon": lambda output, z, abar: output,
    "v_prediction": lambda output, z, abar: (
        per_item(abar.sqrt(), z) * output + per_item((1 - abar).sqrt(), z) * z
    ),
    "velocity": lambda output, z, abar: noise_of_velocity(output, z, abar),
    "sample": lambda output, z, abar: (
        (z - per_item(abar.sqrt(), z) * output) / per_item((1 - abar).sqrt(), z)
    ),
}
"""Conversions of the network's output to the noise, by prediction type: the noise itself,
v = sqrt(abar) eps - sqrt(1 - abar) x0 (Salimans and Ho 2022), a flow's eps - x0, or x0.
"""


def perp_neg(
    cond: Float[Tensor, "B c h w"],
    uncond: Float[Tensor, "B c h w"],
    negative: Float[Tensor, "B 2 c h w"],
    weights: Float[Tensor, "B 2"],
) -> Float[Tensor, "B c h w"]:
    """Compute eps_u + d + sum_i w_i (n_i - proj_d n_i), where d = eps_c - eps_u, n_i = eps_i -
    eps_u (Armandpour et al. 2023, eq. 9).

    Classifier-free guidance with scale s turns this into eps_u + s (d + ...), the paper's formula.
    """
    wanted = (cond - uncond)[:, None]
    unwanted = negative - uncond[:, None]
    inner = (unwanted * wanted).sum(dim=(2, 3, 4), keepdim=True)
    length = wanted.square().sum(dim=(2, 3, 4), keepdim=True).clamp_min(1e-6)
    perpendicular = unwanted - inner / length * wanted
    return cond + (weights.to(cond)[:, :, None, None, None] * perpendicular).sum(dim=1)


def rescaled(
    guided: Float[Tensor, "B c h w"],
    cond: Float[Tensor, "B c h w"],
    z: Float[Tensor, "B c h w"],
    abar: Float[Tensor, " B"],
    share: float,
) -> Float[Tensor, "B c h w"]:
    """Rescale the guided noise so that its x0 has the standard deviation of the conditional x0 (Lin
    et al. 2023, arXiv:2305.08891, section 3.4).

    Args:
        share: 0 for no effect, 1 for the full rescaling; linear between.
    """
    x0, reference = predict_x0(z, guided, abar), predict_x0(z, cond, abar)
    factor = _deviation(reference) / _deviation(x0)
    x0 = x0 * (share * factor + 1 - share)
    return PREDICTIONS["sample"](x0, z, abar)


def _deviation(x: Float[Tensor, "B c h w"]) -> Float[Tensor, "B 1 1 1"]:
    return x.std(dim=(1, 2, 3), keepdim=True).clamp_min(1e-8)

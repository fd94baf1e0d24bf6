"""Rectified flow as a diffusion: conversions between its straight paths and the noise schedules of
``sds.py``.

A rectified flow (Liu et al. 2023; Esser et al. 2024, eq. 13) is trained on

    z_sigma = (1 - sigma) x + sigma eps,    v = eps - x,    0 <= sigma <= 1.

Divided by sqrt((1 - sigma)^2 + sigma^2) this is z = sqrt(abar) x + sqrt(1 - abar) eps with

    abar = (1 - sigma)^2 / ((1 - sigma)^2 + sigma^2),

the same picture and noise, so every formula on noise predictions also applies to a flow. ``sigma``
and ``abar`` are given per item, (B,)."""

import torch
from jaxtyping import Float
from torch import Tensor


def per_item(values: Float[Tensor, " B"], like: Tensor) -> Tensor:
    """Reshape (B,) to (B, 1, ..., 1) in the type and on the device of ``like``."""
    return values.to(like).reshape(-1, *[1] * (like.dim() - 1))


def abar_of_sigma(sigma: Float[Tensor, " B"]) -> Float[Tensor, " B"]:
    """Return the abar of the diffusion with the same ratio of picture and noise."""
    return (1 - sigma).square() / ((1 - sigma).square() + sigma.square())


def sigma_of_abar(abar: Float[Tensor, " B"]) -> Float[Tensor, " B"]:
    """Return sigma, the inverse of :func:`abar_of_sigma`."""
    return (1 - abar).sqrt() / (abar.sqrt() + (1 - abar).sqrt())


def on_path(z: Float[Tensor, "B *d"], abar: Float[Tensor, " B"]) -> Float[Tensor, "B *d"]:
    """Scale the noisy latent of a diffusion to that of the flow: z_sigma = z / (sqrt(abar) +
    sqrt(1 - abar)).
    """
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

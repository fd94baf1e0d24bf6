"""DDIM inversion: the deterministic trajectory from a clean latent towards noise."""

from collections.abc import Callable
from typing import NamedTuple, Optional

import torch
from jaxtyping import Float, Int
from torch import Tensor

from . import sds


class Step(NamedTuple):
    """The items of a batch that one step of an inversion moves to larger noise."""

    index: int
    rows: Int[Tensor, " R"]
    """Indices of the items."""
    z: Float[Tensor, "R c h w"]
    t: Int[Tensor, " R"]
    """The timestep of z, before the step."""


Predict = Callable[[Step], Float[Tensor, "R c h w"]]


def invert(
    predict: Predict,
    x: Float[Tensor, "B c h w"],
    t: Int[Tensor, " B"],
    alphas_cumprod: Float[Tensor, " T"],
    stride: int,
    *,
    eta: float = 0.0,
    fresh: Optional[Predict] = None,
) -> Float[Tensor, "B c h w"]:
    """Follow DDIM (Song et al. 2021, eq. 12 with eta 0) from x, taken as the latent of timestep 0,
    to each item's timestep t.

    Args:
        predict: returns the noise in the latents of a step.
        alphas_cumprod: abar by timestep.
        stride: timesteps of one step; the last one ends at t.
        eta: standard deviation of the noise that a step adds, as a share of that of DDPM's reverse
            step (Song et al. 2021, eq. 16), as threestudio's SDI does.
        fresh: returns the standard normal noise that a step adds; needed if ``eta`` isn't 0.
    """
    z, alphas_cumprod = x, alphas_cumprod.to(x.device)
    for index, start in enumerate(range(0, int(t.max()), stride)):
        rows = (t > start).nonzero()[:, 0]
        chosen = z if len(rows) == len(z) else z[rows]
        step = Step(index, rows, chosen, torch.full_like(rows, start))
        now, later = alphas_cumprod[start], alphas_cumprod[t[rows].clamp_max(start + stride)]
        moved = sds.ddim_step(step.z, predict(step), now.expand(len(rows)), later)
        if eta and fresh is not None:
            deviation = ((1 - now) / (1 - later) * (1 - later / now)).sqrt()
            moved = moved + sds.per_item(eta * deviation, moved) * fresh(step)
        z = moved if len(rows) == len(z) else z.index_copy(0, rows, moved)
    return z

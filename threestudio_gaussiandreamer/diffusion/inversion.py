"""DDIM inversion: the deterministic trajectory from a clean latent towards noise."""

from collections.abc import Callable
from functools import lru_cache
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
Fresh = Callable[[int], Float[Tensor, "B c h w"]]


Factors = tuple[float, float, float]
"""What a step multiplies z, the predicted noise and fresh noise by."""


def invert(
    predict: Predict,
    x: Float[Tensor, "B c h w"],
    t: Int[Tensor, " B"],
    alphas_cumprod: Float[Tensor, " T"],
    stride: int,
    *,
    eta: float = 0.0,
    fresh: Optional[Fresh] = None,
) -> Float[Tensor, "B c h w"]:
    """Follow DDIM (Song et al. 2021, eq. 12 with eta 0) from x, taken as the latent of timestep 0,
    to each item's timestep t.

    Args:
        predict: returns the noise in the latents of a step.
        alphas_cumprod: abar by timestep.
        stride: timesteps of one step; the last one ends at t.
        eta: standard deviation of the noise that a step adds, as a share of that of DDPM's reverse
            step (Song et al. 2021, eq. 16), as threestudio's SDI does.
        fresh: returns the standard normal noise of all items in a step, given its index; needed if
            ``eta`` isn't 0.
    """
    factors = _factors(alphas_cumprod, stride, eta)
    ends, result = t.tolist(), x.clone()
    # in this order, the items that end in a step are the first of those that are left
    order = [i for i in sorted(range(len(ends)), key=ends.__getitem__) if ends[i]]
    rows = torch.tensor(order, dtype=torch.long, device=x.device)
    # a step writes to memory that is there: to allocate it takes longer than the arithmetic
    z = x.index_select(0, rows)
    spare, noise = torch.empty_like(z), torch.zeros_like(z)
    for index, start in enumerate(range(0, max(ends), stride)):
        predicted = predict(Step(index, rows, z, torch.full_like(rows, start)))
        if eta and fresh is not None:
            torch.index_select(fresh(index).to(x), 0, rows, out=noise)
        count = sum(ends[item] <= start + stride for item in order)
        for row, item in enumerate(order[:count]):
            _move(factors[ends[item]], z[row], predicted[row], noise[row], out=result[item])
        if count:
            order, values = order[count:], (rows, z, spare, predicted, noise)
            rows, z, spare, predicted, noise = (v[count:] for v in values)
        if order:
            _move(factors[start + stride], z, predicted, noise, out=spare)
            z, spare = spare, z
    return result


def _move(factors: Factors, z: Tensor, predicted: Tensor, noise: Tensor, out: Tensor) -> None:
    ratio, slope, deviation = factors
    torch.mul(z, ratio, out=out).add_(predicted, alpha=slope)
    if deviation:
        out.add_(noise, alpha=deviation)


@lru_cache(maxsize=4)
def _factors(alphas_cumprod: Float[Tensor, " T"], stride: int, eta: float) -> list[Factors]:
    """Return the factors of the step that ends at each timestep, from the last multiple of the
    stride before.
    """
    ends = torch.arange(len(alphas_cumprod), device=alphas_cumprod.device)
    now, later = alphas_cumprod[(ends - 1).clamp_min(0) // stride * stride], alphas_cumprod
    variance = (1 - now) / (1 - later) * (1 - later / now)
    deviation = eta * variance.clamp_min(0).sqrt()
    return [*zip(*(f.tolist() for f in (*sds.ddim_factors(now, later), deviation)), strict=True)]

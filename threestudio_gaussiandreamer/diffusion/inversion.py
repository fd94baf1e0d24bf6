"""DDIM inversion: the deterministic trajectory from a clean latent towards noise."""

import itertools
from collections.abc import Callable, Iterable
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
        x: float32 or float64.
        alphas_cumprod: abar by timestep.
        stride: timesteps of one step; the last one ends at t.
        eta: standard deviation of the noise that a step adds, as a share of that of DDPM's reverse
            step (Song et al. 2021, eq. 16), as threestudio's SDI does.
        fresh: returns the standard normal noise of all items in a step, given its index; needed if
            ``eta`` isn't 0.
    """
    ends = t.tolist()
    # in this order, the items that have ended are always the first
    order = sorted(range(len(ends)), key=ends.__getitem__)
    rows = left = torch.tensor(order, dtype=torch.long, device=x.device)
    table = _factors(alphas_cumprod, stride, eta)
    factors = _factors_of_steps(table, [ends[item] for item in order], stride, x)
    ended: list[Tensor] = []
    # a step writes to memory that is there: to allocate it takes longer than the arithmetic
    z = x.index_select(0, rows)
    spare, noise = torch.empty_like(z), torch.empty_like(z)
    for index, (ratio, slope, deviation) in enumerate(factors):
        if gone := len(z) - len(ratio):
            ended.append(z[:gone])
            left, z, spare, noise = left[gone:], z[gone:], spare[gone:], noise[gone:]
        predicted = predict(Step(index, left, z, left.new_full(left.shape, index * stride)))
        torch.mul(z, ratio, out=spare).addcmul_(predicted, slope)
        if eta and fresh is not None:
            torch.index_select(fresh(index).to(x), 0, left, out=noise)
            spare.addcmul_(noise, deviation)
        z, spare = spare, z
    return torch.empty_like(x).index_copy_(0, rows, torch.cat([*ended, z]))


def _factors_of_steps(
    table: list[Factors], ends: list[int], stride: int, like: Float[Tensor, "B *d"]
) -> Iterable[tuple[Tensor, Tensor, Tensor]]:
    """Return the factors of each step for the items that it moves, each (R, 1, ..., 1): all of them
    are views of one tensor.

    Args:
        table: the factors of the step that ends at each timestep.
        ends: the timesteps of the items, ascending.
    """
    counts: list[int] = []
    factors: list[float] = []
    for start in range(0, ends[-1], stride):
        moved = [table[min(end, start + stride)] for end in ends if end > start]
        counts += [len(moved)] * 3
        factors += itertools.chain(*zip(*moved, strict=True))
    values = torch.tensor(factors, dtype=like.dtype, device=like.device)
    parts = values.view(-1, *[1] * (like.dim() - 1)).split_with_sizes(counts)
    return zip(parts[::3], parts[1::3], parts[2::3], strict=True)


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

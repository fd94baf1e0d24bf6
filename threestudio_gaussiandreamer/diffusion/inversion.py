"""DDIM inversion: the deterministic trajectory from a clean latent towards noise."""

from collections.abc import Callable
from typing import NamedTuple, Optional

import numpy as np
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


class Plan(NamedTuple):
    """The steps of a batch whose items are in the order of their last timesteps, so that the items
    of a step are a slice.
    """

    order: Int[Tensor, " B"]
    finished: list[int]
    """The number of items that have ended before each step."""
    steps: list[tuple[Tensor, ...]]
    """The timestep before each step, (B,), and what it multiplies, (B, 1, 1, 1): z, the predicted
    noise, and fresh noise.
    """


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
    order, finished, steps = _plan(x, t, alphas_cumprod, stride, eta)
    result, z, spare, left = torch.empty_like(x), x[order], torch.empty_like(x), 0
    for index, (first, values) in enumerate(zip(finished, steps, strict=True)):
        if first > left:
            ended = first - left
            result.index_copy_(0, order[:ended], z[:ended])
            order, z, spare, left = order[ended:], z[ended:], spare[ended:], first
        # a slice takes as long as the arithmetic, so nothing is sliced before an item has ended
        now, ratio, slope, deviation = (v[first:] for v in values) if first else values
        predicted = predict(Step(index, order, z, now))
        torch.mul(z, ratio, out=spare).addcmul_(slope, predicted)
        if eta and fresh is not None:
            spare.addcmul_(deviation, fresh(index).index_select(0, order))
        z, spare = spare, z
    return result.index_copy_(0, order, z)


def _plan(
    x: Float[Tensor, "B c h w"],
    t: Int[Tensor, " B"],
    alphas_cumprod: Float[Tensor, " T"],
    stride: int,
    eta: float,
) -> Plan:
    """Compute the factors of all steps at once, in NumPy, whose calls on so few numbers take a
    third of the time of torch's.
    """
    ends, abar = t.cpu().numpy(), alphas_cumprod.cpu().numpy()
    order = np.argsort(ends, kind="stable")
    ends = ends[order]
    starts = np.arange(0, ends[-1], stride)
    now, later = abar[starts][:, None], abar[np.minimum(starts[:, None] + stride, ends)]
    variance = (1 - now) / (1 - later) * (1 - later / now)
    factors = np.stack((*sds.ddim_factors(now, later), eta * np.maximum(variance, 0) ** 0.5))
    factors = torch.from_numpy(factors).to(x).view(*factors.shape, *[1] * (x.dim() - 1))
    times = torch.from_numpy(starts).to(t.device)[:, None].expand(-1, len(t))
    return Plan(
        torch.from_numpy(order).to(t.device),
        np.searchsorted(ends, starts, side="right").tolist(),
        [*zip(*(values.unbind(0) for values in (times, *factors)), strict=True)],
    )

"""DDIM inversion: the deterministic trajectory from a clean latent towards noise."""

from collections.abc import Callable, Sequence
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
Fresh = Callable[[Step], Sequence[Float[Tensor, "c h w"]]]


class Factors(NamedTuple):
    """What each step multiplies for each item: z by ``ratio``, the predicted noise by ``slope``,
    fresh noise by ``deviation``.
    """

    ratio: Float[Tensor, "K B 1 1 1"]
    slope: Float[Tensor, "K B 1 1 1"]
    deviation: list[list[float]]


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
        fresh: returns the standard normal noise that a step adds to each of its items; needed if
            ``eta`` isn't 0.
    """
    # in the order of their last timesteps, so that the items of a step are a slice
    t, order = t.sort(stable=True)
    starts = torch.arange(0, int(t[-1]), stride, device=t.device)
    factors = _factors(starts, t, alphas_cumprod.to(x.device), stride, eta, x)
    z, spare = x[order], torch.empty_like(x)
    for index, first in enumerate((t <= starts[:, None]).sum(1).tolist()):
        step = Step(index, order[first:], z[first:], starts[index].expand(len(t) - first))
        moved = torch.mul(z[first:], factors.ratio[index, first:], out=spare[first:])
        moved.addcmul_(factors.slope[index, first:], predict(step))
        if eta and fresh is not None:
            for own, noise, by in zip(
                moved, fresh(step), factors.deviation[index][first:], strict=True
            ):
                own.add_(noise, alpha=by)
        if first:
            spare[:first] = z[:first]
        z, spare = spare, z
    return spare.index_copy_(0, order, z)


def _factors(
    starts: Int[Tensor, " K"],
    t: Int[Tensor, " B"],
    alphas_cumprod: Float[Tensor, " T"],
    stride: int,
    eta: float,
    like: Float[Tensor, "B c h w"],
) -> Factors:
    """Compute the factors of all steps at once."""
    now = alphas_cumprod[starts][:, None]
    later = alphas_cumprod[torch.minimum(starts[:, None] + stride, t)]
    deviation = eta * ((1 - now) / (1 - later) * (1 - later / now)).clamp_min(0).sqrt()
    shape = (*later.shape, *[1] * (like.dim() - 1))
    ratio, slope = (factor.to(like).view(shape) for factor in sds.ddim_factors(now, later))
    return Factors(ratio, slope, deviation.tolist())

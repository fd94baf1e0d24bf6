"""Importance of Gaussians, and gradual pruning by it inside the training loop.

Each round keeps a fraction of the Gaussians (``kept_share`` of ``training/density.py``), those with
the highest importance, until a budget is reached; training goes on between rounds, so that they
compensate for the others. Two quantities are collected between rounds:

- the *contribution*, the largest weight sigma_i T_i over the pixels of all views, a by-product of
  rendering (RadSplat, Niemeyer et al. 2024);
- the *removal error*, the squared change of the views if that Gaussian alone were removed, which is
  also small in front of a background of the same colour: :func:`removal_error`.

Importance is the contribution times the square root of the removal error. Each term
alone ranks some redundant Gaussians high; their product does not.

How many Gaussians a scene needs follows from the removal error too: it is the squared error that a
Gaussian saves, so pruning ends where those that a round would drop save more of the error to the
ground truth than they are worth: :func:`needed_count`.
"""

import math
from typing import NamedTuple, Optional

import torch
from jaxtyping import Float, Int8
from torch import Tensor

from ..core.devices import to_device
from ..core.distributed import all_sum, draw_shared
from ..core.tensors import given_gradient

SAMPLES = 12
"""Approximate number of samples of the removal error per round; each costs a backward pass."""
SLOPE, POWER = 0.12, 2
"""What a round costs where twice as many Gaussians gain 0.5 dB, dB per doubling and before training
recovers any of it; and the power of that cost with which the gain grows. Measured on ten objects
(reports/how_many_gaussians.md).
"""
IDLE = 0.01
"""Share of an equal part of the error, E / N, that a Gaussian must save to be worth keeping."""


def importance(
    contribution: Float[Tensor, " N"], removal: Float[Tensor, " N"]
) -> Float[Tensor, " N"]:
    """Return the importance of each Gaussian; the lowest are pruned first."""
    # of the contribution alone where no step has sampled the removal error
    return removal.sqrt() * contribution if removal.any() else contribution


def removal_error(
    images: Float[Tensor, "B H W C"],
    opacities: Float[Tensor, " N"],
    rng: torch.Generator,
    added: Optional[tuple[Tensor, Tensor]] = None,
) -> Float[Tensor, " N"]:
    """Draw an unbiased estimate of the removal error of each Gaussian: the squared change of the
    views without it, summed over pixels and channels.

    A pixel I_p is linear in the opacity o of each Gaussian, so d_p = o dI_p/do is exactly the
    change if that Gaussian alone is removed (except in pixels where its alpha is capped, which have
    no gradient). For random signs z_p, the expectation of (sum_p z_p d_p)^2 is sum_p d_p^2
    (Hutchinson 1989), so one backward pass serves all Gaussians. Several processes sum over
    the views of all of them.

    Args:
        images: rendered views, whose graph is kept.
        opacities: the tensor that they were rendered with.
        added: alpha (B, H, W, 1), rendered with the images, and a colour C (B, bh, bw, C), which
            may be negative: the views had it but ``images`` I don't show it; they become
            I + (1 - alpha) C.
    """

    def draw(count: int) -> Int8[Tensor, "count H W C"]:
        # the numbers of 2 * torch.randint(0, 2, shape) - 1 in less time
        bits = torch.empty((count, *images.shape[1:]), dtype=torch.bool).random_(generator=rng)
        return bits.view(torch.int8).mul_(2).sub_(1)

    signs = to_device(draw_shared(len(images), draw), images.device).to(images)
    # of the sum of signed pixels only the gradient is needed
    zero = images.new_zeros(())
    total = given_gradient(images, signs, zero)
    if added is not None:
        alpha, color = added
        of_alpha = _sum_of_products(signs, color).neg_()
        total = total + given_gradient(alpha, of_alpha, zero)
    (gradients,) = torch.autograd.grad(total, opacities, retain_graph=True)
    gradients = all_sum(gradients)
    return (opacities.detach() * gradients).square().nan_to_num(nan=0.0)


def _sum_of_products(
    a: Float[Tensor, "B H W C"], b: Float[Tensor, "B #H #W C"]
) -> Float[Tensor, "B H W 1"]:
    """Sum a b over the channels; torch's sums over a short last dimension are slow."""
    total = a[..., :1] * b[..., :1]
    for channel in range(1, a.shape[-1]):
        at = slice(channel, channel + 1)
        total.addcmul_(a[..., at], b[..., at])
    return total


class Need(NamedTuple):
    """How many Gaussians a scene needs, as :func:`needed_count` found it."""

    count: int
    gain: float
    """The dB per doubling of their number, around it; negative if that isn't known."""
    enough: bool = False
    """Whether fewer would lose more than asked for, so that only idle Gaussians are dropped."""

    def __str__(self) -> str:
        gain = "1 dB or more" if self.gain >= 1 else f"{self.gain:.1g} dB"
        return f"{'half as many would lose' if self.enough else 'twice as many would gain'} {gain}"


def needed_count(
    scores: Float[Tensor, " N"],
    removal: Float[Tensor, " N"],
    error: float,
    gain: float,
    keep: float,
) -> Need:
    """Return how many Gaussians the next round keeps: rounds end where twice as many gain ``gain``.

    If k of N Gaussians with the removal errors e_i are dropped, the squared error E grows by about
    the sum of e_i: a cost of 10 log10(1 + sum e_i / E) dB for log2(N / (N - k)) halvings. Training
    recovers most of it, so the cost where rounds should end is much smaller than ``gain``:
    ``SLOPE`` (gain / 0.5 dB)^(1 / ``POWER``), as measured. From ``keep`` times that cost on, a
    round drops fewer Gaussians; at that cost only idle ones.

    Args:
        scores: those with the lowest are dropped first.
        removal: removal errors, in the unit of ``error``.
        error: squared error of the same views; 0 if no view was sampled: nothing is dropped.
        keep: smallest fraction that a round keeps, since Gaussians that hide each other seem idle.
    """
    here, wanted = len(scores), SLOPE * (gain / 0.5) ** (1 / POWER)
    drop = here - int(keep * here)
    if not (drop and math.isfinite(error) and error > 0):
        return Need(here, -1.0)
    lowest = torch.argsort(scores, stable=True)[:drop]
    cost = 10 * math.log10(1 + float(removal[lowest].double().sum()) / error)
    cost /= math.log2(here / (here - drop)) if drop < here else 1.0
    busy = int((removal * here >= IDLE * error).sum())
    share = min(max(cost / wanted, keep), 1.0)
    count = max(here - drop, min(int(share * here), busy))
    return Need(count, 0.5 * (cost / SLOPE) ** POWER, share == 1.0)

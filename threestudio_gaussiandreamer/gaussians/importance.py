"""Importance of Gaussians, and gradual pruning by it inside the training loop.

A round keeps the share of the Gaussians with the highest importance, down to a budget, and training
goes on between rounds, so that those that stay take over from those that went. Two quantities are
collected between rounds:

- the *contribution*, the largest weight sigma_i T_i over the pixels of all views, a by-product of
  rendering (RadSplat, Niemeyer et al. 2024);
- the *removal error*, the squared change of the views if that Gaussian alone were removed, which is
  also small where what lies behind has the same colour: :func:`removal_error`.

The score ``removal`` is the root of the removal error times the contribution. Each term alone ranks
some redundant Gaussians high; their product does not.

Ranked by the contribution, the top Gaussian of a pixel goes last, and under ``auto`` never
(SafeguardGS, Lee et al. 2024): the weights of one pixel sum to at most 1, so one above 1/2 belongs
to its top. Such a Gaussian may hold a single pixel that its neighbours would show as well; keeping
them all costs half a dB (docs/results.md), so ``removal`` doesn't."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .densify import Change, prune_to

SCORES = ("removal", "contribution", "opacity", "random")
"""What Gaussians can be ranked by; the last two are controls to compare with."""
SAMPLES = 12
"""How often the removal error is sampled between two rounds, about: each sample costs a backward
pass.
"""
TOP_OF_A_PIXEL = 0.5
"""A weight above this is the largest of its pixel."""
BISECTIONS = 4
"""Of :func:`smallest_count`, which so finds the count within 1/16 of what a round may drop."""


class VisibilityStats(NamedTuple):
    """What each Gaussian contributed to the views since the last round."""

    contribution: Float[Tensor, " N"]
    removal: Float[Tensor, " N"]


def importance_by(
    name: str, logit_opacities: Float[Tensor, " N"], stats: VisibilityStats, rng: torch.Generator
) -> Float[Tensor, " N"]:
    """Return the importance of each Gaussian by one of ``SCORES``; the lowest are pruned first."""
    if name == "opacity":
        return logit_opacities.detach()
    if name == "random":
        return torch.rand(len(stats.contribution), generator=rng).to(stats.contribution.device)
    if name == "contribution" or not stats.removal.any():  # no step has sampled the removal error
        return stats.contribution
    return stats.removal.sqrt() * stats.contribution


def removal_error(
    images: Float[Tensor, "B H W C"], opacities: Float[Tensor, " N"], rng: torch.Generator
) -> Float[Tensor, " N"]:
    """Sample, without bias, the squared change of the views without each Gaussian, summed over
    pixels and channels.

    A pixel I_p is linear in the opacity o of each Gaussian, so that d_p = o dI_p/do is exactly what
    it alone adds (but for pixels in which its alpha is capped, and has no gradient). With signs z_p
    drawn at random, the mean of (sum_p z_p d_p)^2 is sum_p d_p^2 (Hutchinson 1989): one backward
    pass for all Gaussians.

    Args:
        images: rendered views, whose graph is kept.
        opacities: the tensor that they were rendered with.
    """
    signs = torch.randint(0, 2, images.shape, generator=rng).to(images) * 2 - 1
    (gradients,) = torch.autograd.grad(images, opacities, signs, retain_graph=True)
    return (opacities.detach() * gradients).square().nan_to_num(nan=0.0)


def next_count(count: int, keep: float, budget: int) -> int:
    """Return the count after a round that keeps the share ``keep``: never below the budget, and
    never above what is there.
    """
    return min(count, max(budget, int(keep * count)))


def top_count(contribution: Float[Tensor, " N"]) -> int:
    """Count the known top Gaussians of pixels; they are the first by contribution."""
    return int((contribution > TOP_OF_A_PIXEL).sum())


def smallest_count(
    scores: Float[Tensor, " N"], least: int, acceptable: Callable[[Bool[Tensor, " N"]], bool]
) -> int:
    """Find the smallest count, at least ``least``, with acceptable quality.

    Args:
        scores: the highest are kept.
        acceptable: tells whether the quality is when only the marked Gaussians are drawn; taken to
            be monotone, and called at most ``BISECTIONS + 1`` times.
    """
    order = torch.argsort(scores, descending=True, stable=True)
    high = len(scores)
    low = min(high, least)
    if low == high or acceptable(mark_first(order, low)):
        return low
    for _ in range(BISECTIONS):
        middle = (low + high) // 2
        low, high = (low, middle) if acceptable(mark_first(order, middle)) else (middle, high)
    return high


def mark_first(order: Tensor, count: int) -> Bool[Tensor, " N"]:
    """Mark the first ``count`` rows of an order."""
    marked = torch.zeros_like(order, dtype=torch.bool)
    marked[order[:count]] = True
    return marked


def keep_highest(
    params: Mapping[str, Tensor],
    scores: Float[Tensor, " N"],
    count: int,
    first: Change | None = None,
) -> Change:
    """Return the change that keeps the ``count`` rows of ``params`` with the highest scores, in
    their order; where ``params`` are what the change ``first`` made, that change and this one.
    """
    change = prune_to(params, scores, count)
    return (
        change
        if first is None
        else Change(first.parents[change.parents], first.is_new[change.parents], change.values)
    )

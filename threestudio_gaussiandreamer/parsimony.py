"""No more Gaussians than a scene needs: gradual pruning by contribution, inside the training loop.

A round keeps the best share of the cloud by score, down to a budget, and training goes on between rounds, so that what stays
takes over what went. The score is a Gaussian's contribution: the largest sigma_i T_i over the pixels of the views since the last
round (RadSplat, Niemeyer et al. 2024), a by-product of rendering.

Never the top Gaussian of a pixel (SafeguardGS, Lee et al. 2024): the weights sigma_i T_i of one pixel sum to at most 1, so one
that exceeds 1/2 belongs to the top Gaussian of its pixel. Ranking by the largest weight drops such a Gaussian only after all
that are nowhere above 1/2; :func:`smallest_count` never drops one.
"""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .densify import Change, prune_to

SCORES = ("contribution", "opacity", "random")
"""What ranks the Gaussians; the others than contribution are controls to compare with."""
TOP_OF_A_PIXEL = 0.5
"""A weight above this is the largest of its pixel."""
PROBES = 4
"""Bisections of :func:`smallest_count`: a sixteenth of what a round may drop."""


def score(name: str, logit_opacities: Float[Tensor, " N"], contribution: Float[Tensor, " N"], rng: torch.Generator) -> Float[Tensor, " N"]:
    """What each Gaussian is worth: the lowest go first."""
    if name == "opacity":
        return logit_opacities.detach()
    if name == "random":
        return torch.rand(len(contribution), generator=rng).to(contribution.device)
    return contribution


def next_count(count: int, keep: float, budget: int) -> int:
    """The count that a round of ``keep`` leads to: never below the budget, and never above what is there."""
    return min(count, max(budget, int(keep * count)))


def smallest_count(
    scores: Float[Tensor, " N"], contribution: Float[Tensor, " N"], keep: float, holds: Callable[[Bool[Tensor, " N"]], bool]
) -> int:
    """The fewest Gaussians, at least ``keep`` of them and no top Gaussian of a pixel missing, with which the quality holds.

    ``holds(kept)`` says whether it does when only the marked Gaussians are drawn; it is taken to be monotone, and asked at most
    ``PROBES + 1`` times.
    """
    order = torch.argsort(scores, descending=True, stable=True)
    high = len(scores)
    low = min(high, max(int(keep * high), int((contribution > TOP_OF_A_PIXEL).sum())))
    if low == high or holds(best(order, low)):
        return low
    for _ in range(PROBES):
        middle = (low + high) // 2
        low, high = (low, middle) if holds(best(order, middle)) else (middle, high)
    return high


def best(order: Tensor, count: int) -> Bool[Tensor, " N"]:
    """The first ``count`` rows of an order, marked."""
    marked = torch.zeros_like(order, dtype=torch.bool)
    marked[order[:count]] = True
    return marked


def pruned(params: Mapping[str, Tensor], scores: Float[Tensor, " N"], count: int, first: Change | None = None) -> Change:
    """The ``count`` best rows of ``params``, in their order; after the change ``first``, if ``params`` are what that one made."""
    change = prune_to(params, scores, count)
    return change if first is None else Change(first.parents[change.parents], first.fresh[change.parents], change.values)

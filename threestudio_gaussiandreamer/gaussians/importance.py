"""No more Gaussians than a scene needs: gradual pruning by what each one shows, inside the training
loop.

A round keeps the best share of the cloud by score, down to a budget, and training goes on between
rounds, so that what stays takes over what went. Two quantities are collected between rounds:

- the *contribution*, the largest weight sigma_i T_i over the pixels of all views, a by-product of
  rendering (RadSplat, Niemeyer et al. 2024);
- the *removal error*, the squared change of the views if that Gaussian alone were gone, which is
  small too where what lies behind has the same colour: :func:`removal_error`.

The score ``removal`` is the root of the removal error times the contribution: each alone keeps what
the other knows to be useless.

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
"""What ranks the Gaussians; the last two are controls to compare with."""
SAMPLES = 12
"""Of the removal error between two rounds, about: each costs a backward pass."""
TOP_OF_A_PIXEL = 0.5
"""A weight above this is the largest of its pixel."""
PROBES = 4
"""Bisections of :func:`smallest_count`: a sixteenth of what a round may drop."""


class Seen(NamedTuple):
    """What was seen of each Gaussian since the last round."""

    contribution: Float[Tensor, " N"]
    removal: Float[Tensor, " N"]


def score(
    name: str, logit_opacities: Float[Tensor, " N"], seen: Seen, rng: torch.Generator
) -> Float[Tensor, " N"]:
    """What each Gaussian is worth: the lowest go first."""
    if name == "opacity":
        return logit_opacities.detach()
    if name == "random":
        return torch.rand(len(seen.contribution), generator=rng).to(seen.contribution.device)
    if (
        name == "contribution" or not seen.removal.any()
    ):  # as long as no step has sampled the removal error
        return seen.contribution
    return seen.removal.sqrt() * seen.contribution


def removal_error(
    images: Float[Tensor, "B H W C"], opacities: Float[Tensor, " N"], rng: torch.Generator
) -> Float[Tensor, " N"]:
    """An unbiased sample of what each Gaussian shows: the squared change of the views without it,
    summed over pixels and channels.

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
    """The count that a round of ``keep`` leads to: never below the budget, and never above what is
    there.
    """
    return min(count, max(budget, int(keep * count)))


def top_count(contribution: Float[Tensor, " N"]) -> int:
    """How many are known to be the top Gaussian of a pixel; they are the first by contribution."""
    return int((contribution > TOP_OF_A_PIXEL).sum())


def smallest_count(
    scores: Float[Tensor, " N"], least: int, holds: Callable[[Bool[Tensor, " N"]], bool]
) -> int:
    """The fewest Gaussians, at least ``least``, with which the quality holds.

    ``holds(kept)`` says whether it does when only the marked Gaussians are drawn; it is taken to be
    monotone, and asked at most ``PROBES + 1`` times."""
    order = torch.argsort(scores, descending=True, stable=True)
    high = len(scores)
    low = min(high, least)
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


def pruned(
    params: Mapping[str, Tensor],
    scores: Float[Tensor, " N"],
    count: int,
    first: Change | None = None,
) -> Change:
    """The ``count`` best rows of ``params``, in their order; after the change ``first``, if
    ``params`` are what that one made.
    """
    change = prune_to(params, scores, count)
    return (
        change
        if first is None
        else Change(first.parents[change.parents], first.is_new[change.parents], change.values)
    )

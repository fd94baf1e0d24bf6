"""Timesteps that fall during a run, the same for all items of a step, in place of random ones.

Each schedule maps the progress of the run, p = step / steps in [0, 1], to a timestep between the
largest one, high, and the smallest, low. The cumulative noise schedule is ``abar`` as in
``sds.py``."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.errors import unknown

PRIOR_CENTERS = (500, 800)
PRIOR_WIDTHS = (100, 300)
"""m2, m1 and s2, s1 of DreamTime, in timesteps of 1000."""


def linear(progress: float, low: int, high: int, abar: Float[Tensor, " T"]) -> int:
    """Return high - (high - low) p."""
    return round(high - (high - low) * progress)


def square_root(progress: float, low: int, high: int, abar: Float[Tensor, " T"]) -> int:
    """Return high - (high - low) sqrt(p), the annealing of HiFA (Zhu et al. 2023,
    arXiv:2305.18766, section 4): large timesteps for a short time.
    """
    return round(high - (high - low) * progress**0.5)


def time_prioritized(progress: float, low: int, high: int, abar: Float[Tensor, " T"]) -> int:
    """Return the timestep t whose share of the weights above it is p (DreamTime, Huang et al. 2023,
    arXiv:2306.12422, TP-SDS): the t that is nearest to sum_{i >= t} W(i) = p, with W normalised to
    1 on [low, high].
    """
    weights = time_priorities(abar)[low : high + 1]
    above = weights.flip(0).cumsum(0) / weights.sum()
    return high - int((above - progress).abs().argmin())


def time_priorities(abar: Float[Tensor, " T"]) -> Float[Tensor, " T"]:
    """Compute DreamTime's W(t) = W_d(t) W_p(t), float64, not normalised.

    W_d = sqrt((1 - abar) / abar) is the weight of the training objective; W_p favours the middle
    timesteps: 1 between m2 and m1, a half Gaussian of width s1 above m1 and of width s2 below m2.
    """
    abar = abar.double().cpu()
    t = torch.arange(len(abar), dtype=torch.float64) * (1000 / len(abar))
    (low, high), (narrow, wide) = PRIOR_CENTERS, PRIOR_WIDTHS
    below, above = ((t - low) / narrow).clamp(max=0), ((t - high) / wide).clamp(min=0)
    prior = torch.exp(-0.5 * (below**2 + above**2))
    return ((1 - abar) / abar).sqrt() * prior


SCHEDULES: dict[str, Callable[[float, int, int, Tensor], int]] = {
    "linear": linear,
    "sqrt": square_root,
    "dreamtime": time_prioritized,
}


def scheduled_timestep(
    name: str, step: int, steps: int, low: int, high: int, abar: Float[Tensor, " T"]
) -> int:
    """Return the timestep of optimiser step ``step`` of ``steps``; after those it stays at the
    smallest one.

    Raises:
        UserError: the name isn't one of ``SCHEDULES``.
    """
    if name not in SCHEDULES:
        raise unknown("timestep_schedule", name, SCHEDULES)
    return SCHEDULES[name](min(step / max(steps - 1, 1), 1.0), low, high, abar)

"""Means over prompts with confidence intervals, and paired differences of two sets of results."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.streams import numpy_generator

DRAWS = 2000
LEVEL = 0.95


class Estimate(NamedTuple):
    """A mean with its interval; NaN where there are no values."""

    mean: float
    low: float
    high: float
    count: int
    """Number of prompts."""


def bootstrap(values: Float[np.ndarray, " N"], *, seed: int = 0) -> Estimate:
    """Return the mean and its percentile bootstrap interval (Efron 1979) of level LEVEL.

    Args:
        values: one for each prompt; NaN where the metric isn't defined, which is left out.
    """
    values = values[~np.isnan(values)]
    if not len(values):
        return Estimate(np.nan, np.nan, np.nan, 0)
    rows = numpy_generator(seed, "bootstrap").integers(len(values), size=(DRAWS, len(values)))
    low, high = np.quantile(values[rows].mean(axis=1), [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Estimate(float(values.mean()), float(low), float(high), len(values))


def per_prompt(prompts: list[str], values: Float[np.ndarray, " N"]) -> dict[str, float]:
    """Return the mean over the results of each prompt; NaNs are left out."""
    groups: dict[str, list[float]] = {}
    for prompt, value in zip(prompts, values, strict=True):
        groups.setdefault(prompt, []).append(float(value))
    known = {prompt: [v for v in group if not np.isnan(v)] for prompt, group in groups.items()}
    return {prompt: float(np.mean(v)) if v else float("nan") for prompt, v in known.items()}


def paired(first: dict[str, float], second: dict[str, float], *, seed: int = 0) -> Estimate:
    """Return the mean of first minus second over the prompts that both have."""
    common = [prompt for prompt in first if prompt in second]
    return bootstrap(np.array([first[p] - second[p] for p in common], float), seed=seed)

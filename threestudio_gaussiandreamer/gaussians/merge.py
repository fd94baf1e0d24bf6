"""Merge duplicates: replace two Gaussians of nearly the same position, shape and colour by one with
the moments of both.

Pruning can't remove duplicates: each of two copies is in front in some views, so both contribute.
The cost of a pair is the bound B(i, j) of Runnalls 2007 ("Kullback-Leibler approach to Gaussian
mixture reduction") over w_i + w_j. It measures how much larger the merged Gaussian is than its
parts, in position and in colour; colour is treated as an additional dimension with the standard
deviation ``COLOR_TOLERANCE``:

    cost = 1/2 (log |S| - f log |S_i| - (1 - f) log |S_j| + log(1 + f (1 - f) |c_i - c_j|^2 /
    tolerance^2))
    S    = f S_i + (1 - f) S_j + f (1 - f) (m_i - m_j)(m_i - m_j)^T,   f = w_i / (w_i + w_j),   w =
         opacity x mean cross-section

In the cost, f is at least ``LEAST_SHARE`` and at most 1 - ``LEAST_SHARE``. Otherwise a large
Gaussian would be a duplicate of every small one near it, since the cost goes to 0 with the share of
one of the two, whatever its size; it would absorb one after another and grow with each."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..splatting.projection import quats_to_rotations
from .neighbours import NeighbourSearch
from .sh import C0

DUPLICATE = 0.07
"""Largest cost of a pair that is merged: merging all such pairs leaves a PSNR of 50 dB or more to
the original, for untrained clouds too.
"""
COLOR_TOLERANCE = 0.1
LEAST_SHARE = 1e-3
NEIGHBOURS = 4
PAIRS_AT_ONCE = 2**18
"""Pairs whose properties are in memory at the same time."""
LOG_THINNEST = -12.0
"""Smallest logarithm of the ratio of an axis to the longest one; shorter axes are clamped to it, so
that covariances are well conditioned in float64.
"""


class _Shapes(NamedTuple):
    """Properties of the Gaussians that the costs depend on, float64 on the CPU."""

    means: Float[Tensor, "N 3"]
    log_scales: Float[Tensor, "N 3"]
    """At least ``LOG_THINNEST`` below the largest."""
    quats: Float[Tensor, "N 4"]
    log_determinants: Float[Tensor, " N"]
    """Of the covariances."""
    opacities: Float[Tensor, " N"]
    areas: Float[Tensor, " N"]
    """The mean cross-sections, without a common factor."""
    weights: Float[Tensor, " N"]
    colors: Float[Tensor, "N 3"]


def merge_duplicates(params: Mapping[str, Tensor], *, at_least: int = 1) -> dict[str, Tensor]:
    """Merge all duplicates; return new parameters, a merged Gaussian in the place of its first one.

    Args:
        params: means, log_scales, quats, logit_opacities and the spherical harmonics (sh, or sh0
            and sh_rest).
        at_least: the number of Gaussians is not reduced below this.
    """
    values = {name: value.detach().clone() for name, value in params.items()}
    # cost of the earlier merges that each results from, accumulated, so that a sequence of small
    # merges can't change the result by much
    spent = torch.zeros(len(values["means"]), dtype=torch.float64)
    while True:
        pairs, found = _cheap_pairs(_shapes(values))
        costs = found + spent[pairs].amax(1)
        chosen = _disjoint(pairs, costs)[: max(len(spent) - at_least, 0)]
        if not chosen:
            return values
        stay = torch.ones(len(spent), dtype=torch.bool)
        stay[pairs[chosen, 1]] = False
        spent[pairs[chosen, 0]] = costs[chosen]
        for name, merged in _together(values, pairs[chosen]).items():
            values[name][pairs[chosen, 0].to(values[name].device)] = merged.to(values[name])
        values = {name: value[stay.to(value.device)] for name, value in values.items()}
        spent = spent[stay]


def _disjoint(pairs: Int[Tensor, "P 2"], costs: Float[Tensor, " P"]) -> list[int]:
    """Choose disjoint pairs that cost at most ``DUPLICATE``, those with the lowest cost first."""
    order = costs.argsort(stable=True)[: int((costs <= DUPLICATE).sum())]
    taken, chosen = set(), []
    for row, (first, second) in zip(order.tolist(), pairs[order].tolist(), strict=True):
        if first not in taken and second not in taken:
            taken |= {first, second}
            chosen.append(row)
    return chosen


def _shapes(params: Mapping[str, Tensor]) -> _Shapes:
    means, log_scales, quats, logits = (
        params[name].detach().cpu().double()
        for name in ("means", "log_scales", "quats", "logit_opacities")
    )
    log_scales = log_scales.maximum(log_scales.amax(1, keepdim=True) + LOG_THINNEST)
    opacities = logits.sigmoid()
    harmonics = params["sh0"] if "sh0" in params else params["sh"]
    colors = C0 * harmonics[:, 0].detach().cpu().double()
    areas = (log_scales.sum(1) * (2 / 3)).exp()
    opaque = opacities, areas, opacities * areas
    return _Shapes(means, log_scales, quats, 2 * log_scales.sum(1), *opaque, colors)


def _covariances(shapes: _Shapes, rows: Int[Tensor, " P"]) -> Float[Tensor, "P 3 3"]:
    axes = quats_to_rotations(shapes.quats[rows]) * shapes.log_scales[rows].exp()[:, None]
    return axes @ axes.transpose(1, 2)


def _cheap_pairs(shapes: _Shapes) -> tuple[Int[Tensor, "P 2"], Float[Tensor, " P"]]:
    """Return the pairs of neighbours that cost at most ``DUPLICATE``, each once and its smaller row
    first, in ascending order, and their costs. Gaussians that aren't finite are in none.
    """
    rows, count = shapes.means.isfinite().all(1).nonzero()[:, 0].numpy(), len(shapes.means)
    keys, costs = [torch.zeros(0, dtype=torch.long)], [torch.zeros(0, dtype=torch.float64)]
    for first, second in _neighbours(shapes.means.numpy()[rows]):
        apart = first != second
        both = np.stack([rows[first[apart]], rows[second[apart]]], 1)
        for pairs in torch.from_numpy(np.sort(both, axis=1)).split(PAIRS_AT_ONCE):
            cost = _costs(shapes, pairs)
            low, high = pairs[cost <= DUPLICATE].unbind(1)
            keys.append(low * count + high)
            costs.append(cost[cost <= DUPLICATE])
    keys, places = np.unique(torch.cat(keys).numpy(), return_index=True)
    pairs = np.stack(np.divmod(keys, max(count, 1)), 1)
    return torch.from_numpy(pairs), torch.cat(costs)[places]


def _neighbours(
    points: Float[np.ndarray, "N 3"],
) -> Iterator[tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"]]]:
    """Yield pairs of near points, and of sorted neighbours, as many copies share nearest ones."""
    if len(points) < 2:
        return
    count = min(NEIGHBOURS + 1, len(points))
    for rows, _, nearest in NeighbourSearch(points).of_points(count):
        yield np.repeat(rows, count), nearest.reshape(-1)
    order = np.lexsort(points.T)
    yield order[:-1], order[1:]


def _moments(
    shapes: _Shapes, pairs: Int[Tensor, "P 2"], least: float = 0.0
) -> tuple[Float[Tensor, " P"], Float[Tensor, "P 3"], Float[Tensor, "P 3 3"]]:
    """Return each pair's f, at least ``least`` for both, and its mean and covariance."""
    i, j = pairs.unbind(1)
    f = (shapes.weights[i] / (shapes.weights[i] + shapes.weights[j])).clamp(least, 1 - least)
    apart = shapes.means[i] - shapes.means[j]
    means = shapes.means[j] + f[:, None] * apart
    weight, first, second = f[:, None, None], _covariances(shapes, i), _covariances(shapes, j)
    within = weight * first + (1 - weight) * second
    return f, means, within + weight * (1 - weight) * apart[:, :, None] * apart[:, None]


def _costs(shapes: _Shapes, pairs: Int[Tensor, "P 2"]) -> Float[Tensor, " P"]:
    i, j = pairs.unbind(1)
    f, _, covariances = _moments(shapes, pairs, LEAST_SHARE)
    growth = (
        torch.linalg.slogdet(covariances).logabsdet
        - f * shapes.log_determinants[i]
        - (1 - f) * shapes.log_determinants[j]
    )
    apart = (shapes.colors[i] - shapes.colors[j]).square().sum(1)
    return 0.5 * (growth + torch.log1p(f * (1 - f) * apart / COLOR_TOLERANCE**2))


def _together(params: Mapping[str, Tensor], pairs: Int[Tensor, "P 2"]) -> dict[str, Tensor]:
    """Compute the merged Gaussian of each pair: mean and covariance by :func:`_moments`, opacity
    a + b - a b, less for parts that cover little of it, and the weighted mean of the harmonics.
    """
    from scipy.spatial.transform import Rotation

    params = {name: value.detach().cpu()[pairs.flatten()] for name, value in params.items()}
    shapes, pairs = _shapes(params), torch.arange(2 * len(pairs)).view(-1, 2)
    f, means, covariances = _moments(shapes, pairs)
    # one that covers less than half of the merged area adds as much less to its opacity
    merged_areas = (torch.linalg.slogdet(covariances).logabsdet / 3).exp()
    covered = (2 * shapes.areas[pairs] / merged_areas[:, None]).clamp(max=1)
    spread = shapes.opacities[pairs] * covered
    summed, product = spread.sum(1), spread.prod(1)
    opacities = summed - product
    # The composited alpha of the pair, 1 - (1 - a g)(1 - b g), falls off more slowly than g: scale
    # the covariance so that its integral over the plane is the same.
    growth = (summed - 0.5 * product) / opacities
    variances, axes = torch.linalg.eigh(covariances * growth[:, None, None])
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    x, y, z, w = torch.from_numpy(Rotation.from_matrix(axes.numpy()).as_quat()).unbind(1)
    quats = torch.stack([w, x, y, z], 1)
    mixed = {"means": means, "log_scales": 0.5 * variances.log(), "quats": quats}
    mixed["logit_opacities"] = opacities.clamp(1e-6, 1 - 1e-6).logit()
    for name in params:
        if name not in mixed:
            i, j = params[name].double()[pairs].unbind(1)
            mixed[name] = j + f[:, None, None] * (i - j)
    return mixed

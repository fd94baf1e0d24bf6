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
from .densify import Change, unchanged
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


def merge_duplicates(params: Mapping[str, Tensor], *, at_least: int = 1) -> Change:
    """Merge all duplicates; a merged Gaussian is marked as new, with the first of its pair as the
    parent.

    Args:
        params: means, log_scales, quats, logit_opacities and the spherical harmonics (sh, or sh0
            and sh_rest).
        at_least: the number of Gaussians is not reduced below this.
    """
    change = unchanged(params)
    spent = torch.zeros(len(change.parents), dtype=torch.float64)
    while True:
        most = max(len(change.parents) - at_least, 0)
        pairs, costs = (values[:most] for values in duplicates(change.values, spent))
        if not len(pairs):
            return change
        change, spent = _merged(change, spent, pairs, costs)


def duplicates(
    params: Mapping[str, Tensor], spent: Float[Tensor, " N"]
) -> tuple[Int[Tensor, "P 2"], Float[Tensor, " P"]]:
    """Find disjoint pairs of rows to merge, those with the lowest cost first.

    Args:
        spent: cost of the earlier merges that each row results from.

    Returns:
        the pairs, and their costs including ``spent``.
    """
    pairs, found = _cheap_pairs(_shapes(params))
    # accumulated, so that a sequence of small merges can't change the result by much
    costs = found + spent[pairs].amax(1)
    order = costs.argsort(stable=True)[: int((costs <= DUPLICATE).sum())]
    taken, chosen = set(), []
    for row, (first, second) in zip(order.tolist(), pairs[order].tolist(), strict=True):
        if first not in taken and second not in taken:
            taken |= {first, second}
            chosen.append(row)
    return pairs[chosen], costs[chosen]


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
    keys, costs, count = [], [], len(shapes.means)
    for pairs in _neighbours(shapes.means):
        found = _costs(shapes, pairs)
        low, high = pairs[found <= DUPLICATE].unbind(1)
        keys.append(low * count + high)
        costs.append(found[found <= DUPLICATE])
    if not keys:
        return torch.zeros(0, 2, dtype=torch.long), torch.zeros(0, dtype=torch.float64)
    keys, places = np.unique(torch.cat(keys).numpy(), return_index=True)
    keys = torch.from_numpy(keys)
    return torch.stack([keys // count, keys % count], 1), torch.cat(costs)[places]


def _neighbours(means: Float[Tensor, "N 3"]) -> Iterator[Int[Tensor, "P 2"]]:
    """Pair every finite Gaussian with its nearest neighbours, smaller row first, at most
    ``PAIRS_AT_ONCE`` pairs at a time; most pairs come twice.
    """
    rows = means.isfinite().all(1).nonzero()[:, 0].numpy()
    if len(rows) < 2:
        return
    points, count = means.numpy()[rows], min(NEIGHBOURS + 1, len(rows))
    for found in NeighbourSearch(points).of_points(count):
        yield from _pairs(rows, np.repeat(found.rows, count), found.nearest.reshape(-1))
    # Many copies of one point all have the same few nearest neighbours, hence only one or two
    # disjoint pairs; pairs of neighbours in sorted order are added for them.
    order = np.lexsort(points.T)
    yield from _pairs(rows, order[:-1], order[1:])


def _pairs(
    rows: Int[np.ndarray, " N"], first: Int[np.ndarray, " P"], second: Int[np.ndarray, " P"]
) -> Iterator[Int[Tensor, "P 2"]]:
    """Yield pairs of two different Gaussians from their places in ``rows``."""
    different = first != second
    pairs = np.stack([rows[first[different]], rows[second[different]]], 1)
    yield from torch.from_numpy(np.sort(pairs, axis=1)).split(PAIRS_AT_ONCE)


def _shares(shapes: _Shapes, pairs: Int[Tensor, "P 2"], least: float = 0.0) -> Float[Tensor, " P"]:
    """Return f, the first one's share of the weight of each pair; at least ``least`` for both."""
    first, second = shapes.weights[pairs].unbind(1)
    return (first / (first + second)).clamp(least, 1 - least)


def _moments(
    shapes: _Shapes, pairs: Int[Tensor, "P 2"], f: Float[Tensor, " P"]
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3 3"]]:
    """Return the mean and the covariance of each pair for the first one's share f."""
    i, j = pairs.unbind(1)
    apart = shapes.means[i] - shapes.means[j]
    means = shapes.means[j] + f[:, None] * apart
    weight, first, second = f[:, None, None], _covariances(shapes, i), _covariances(shapes, j)
    within = weight * first + (1 - weight) * second
    return means, within + weight * (1 - weight) * apart[:, :, None] * apart[:, None]


def _costs(shapes: _Shapes, pairs: Int[Tensor, "P 2"]) -> Float[Tensor, " P"]:
    i, j = pairs.unbind(1)
    f = _shares(shapes, pairs, LEAST_SHARE)
    _, covariances = _moments(shapes, pairs, f)
    growth = (
        torch.linalg.slogdet(covariances).logabsdet
        - f * shapes.log_determinants[i]
        - (1 - f) * shapes.log_determinants[j]
    )
    apart = (shapes.colors[i] - shapes.colors[j]).square().sum(1)
    return 0.5 * (growth + torch.log1p(f * (1 - f) * apart / COLOR_TOLERANCE**2))


def _merged(
    change: Change, spent: Tensor, pairs: Int[Tensor, "P 2"], costs: Float[Tensor, " P"]
) -> tuple[Change, Tensor]:
    """Replace the first row of each pair by the merged Gaussian, and remove the second."""
    values, device = change.values, change.parents.device
    for name, merged in _together(values, pairs).items():
        values[name][pairs[:, 0].to(device)] = merged.to(values[name])
    spent[pairs[:, 0]] = costs
    is_new, stay = change.is_new.clone(), torch.ones_like(change.is_new)
    is_new[pairs[:, 0].to(device)], stay[pairs[:, 1].to(device)] = True, False
    left = {name: value[stay] for name, value in values.items()}
    return Change(change.parents[stay], is_new[stay], left), spent[stay.cpu()]


def _together(params: Mapping[str, Tensor], pairs: Int[Tensor, "P 2"]) -> dict[str, Tensor]:
    """Compute the merged Gaussian of each pair: mean and covariance by :func:`_moments`, opacity
    a + b - a b, less for parts that cover little of it, and the weighted mean of the harmonics.
    """
    from scipy.spatial.transform import Rotation

    params = {name: value.detach().cpu()[pairs.flatten()] for name, value in params.items()}
    shapes, pairs = _shapes(params), torch.arange(2 * len(pairs)).view(-1, 2)
    f = _shares(shapes, pairs)
    means, covariances = _moments(shapes, pairs, f)
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

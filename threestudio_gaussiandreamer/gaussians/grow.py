"""Noisy point growing with colour perturbation, and the first size of each Gaussian: the paper's
Algorithm 1.

Stage 1 draws points uniformly in the bounding box of the prior's points; stage 2 keeps those nearer
than a radius to one of them, with that point's colour plus noise; stage 3 takes the distance to the
nearest point as the size of the Gaussian. Lengths are relative to the size of the cloud."""

import logging
from typing import Optional

import numpy as np
from jaxtyping import Float, Int

from .neighbours import NeighbourSearch
from .point_cloud import PointCloud

logger = logging.getLogger(__name__)

SCALE_RULES = {"nearest": 1, "rms3": 3}
"""Number of neighbours over which each rule for the initial scales averages."""
ISOLATED_FACTOR = 10.0
"""A point is isolated if its nearest neighbour is farther away than this many times the 99th
percentile of such distances; its scale is capped at that length."""
FLOOR_FRACTION = 1e-4
"""Distances below this fraction of the median are rounding errors between copies of a point."""
FEW_POINTS_FRACTION = 0.1
"""Scale, in units of the bounding radius, of the Gaussians on fewer than four distinct points."""


def grow(
    cloud: PointCloud,
    *,
    num_candidates: int = 1_000_000,
    radius: float = 0.01,
    color_range: tuple[float, float] = (0.0, 0.2),
    clamp: bool = True,
    max_points: Optional[int] = None,
    generator: np.random.Generator,
) -> PointCloud:
    """Return ``cloud`` followed by the points grown around it (Algorithm 1, stages 1 and 2).

    Args:
        cloud: (P, 3) finite points in any unit, P >= 1, with colours.
        num_candidates: points drawn uniformly in the bounding box.
        radius: distance below which a candidate is kept, as a share of the longest side of the
            bounding box without isolated points (the paper's "normalized" 0.01).
        color_range: uniform noise added to each channel of the nearest point's colour; the paper's
            (0, 0.2) brightens the grown points by 0.1 on average.
        clamp: keep the grown colours in [0, 1]; the released code lets them reach 1.2.
        max_points: largest number of grown points.
        generator: the only source of randomness.
    """
    points = np.asarray(cloud.points, np.float64)
    first, group, _ = distinct(points)  # trees are slow with many copies of one point
    search, typical = NeighbourSearch(points[first]), points
    if len(first) >= 4:  # one isolated point far away would stretch the box, and the radius with it
        apart = _neighbour_distances(search, 1)
        typical = points[(apart <= _isolation_cap(apart))[group]]
    reach = radius * (longest_side(typical) or 1.0)  # a single point has no size: one world unit
    low, high = typical.min(axis=0), typical.max(axis=0)
    # each side is at least twice the reach, so that points also grow off the plane of a flat cloud
    padding = np.maximum(reach - (high - low) / 2, 0.0)
    candidates = generator.uniform(low - padding, high + padding, size=(num_candidates, 3))
    distances, nearest = search.nearest(candidates, reach)
    kept = np.flatnonzero(distances < reach)
    found = "growing: %d of %d candidates lie within %.4g of %d points"
    logger.info(found, len(kept), num_candidates, reach, len(first))
    # Candidates are independent, so the first ones are a uniform choice among those kept.
    kept = kept[:max_points]
    nearest = first[nearest[kept]]
    colors = cloud.colors[nearest]
    colors = colors + generator.uniform(*color_range, size=colors.shape)
    colors = (colors.clip(0.0, 1.0) if clamp else colors).astype(np.float32)
    normals = None if cloud.normals is None else cloud.normals[nearest]
    return cloud.followed_by(PointCloud(candidates[kept], colors, normals))


def longest_side(points: Float[np.ndarray, "P 3"]) -> float:
    """Return the longest side of the bounding box, in the unit of the points."""
    return float(np.ptp(np.asarray(points, np.float64), axis=0).max())


def nearest_distance_scales(
    points: Float[np.ndarray, "P 3"], rule: str = "nearest"
) -> Float[np.ndarray, " P"]:
    """Return the initial scale (standard deviation) of the Gaussian at each point, from the
    distance to its neighbours.

    The result is positive and finite for every cloud. A point with an exact copy, whose distance is
    zero, gets the median distance. An isolated point gets at most ``ISOLATED_FACTOR`` times the
    99th percentile, and fewer than four distinct points get a fraction of their bounding radius.

    Args:
        points: (P, 3) in any unit, which is the unit of the result; finite, P >= 1.
        rule: "nearest", the distance to the nearest other point (the paper), or "rms3", the root of
            the mean of the squared distances to the nearest three (the released code).
    """
    points = np.asarray(points, np.float64)  # in float32 squares of tiny distances underflow
    first, group, copies = distinct(points)
    if len(first) < 4:
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        radius = np.linalg.norm(points - middle, axis=1).max() or 1.0  # in one place: the unit
        scales = np.full(len(points), FEW_POINTS_FRACTION * radius)
    else:
        distances = _neighbour_distances(NeighbourSearch(points[first]), SCALE_RULES[rule])
        cap = _isolation_cap(distances)
        if count := int((distances > cap).sum()):
            isolated = "%d of %d points are isolated: the size of their Gaussians is capped at %.4g"
            logger.warning(isolated, count, len(distances), cap)
        distances = distances.clip(FLOOR_FRACTION * np.median(distances), cap)
        distances[copies > 1] = np.median(distances)
        scales = distances[group]
    limits = np.finfo(np.float32)
    return scales.clip(limits.tiny, limits.max).astype(np.float32)


def distinct(
    points: Float[np.ndarray, "P 3"],
) -> tuple[Int[np.ndarray, " D"], Int[np.ndarray, " P"], Int[np.ndarray, " D"]]:
    """Group equal points.

    Returns:
        index of the first point at each of the D positions, the position of each point, and the
        number of points at each position.
    """
    order = np.lexsort(points.T)
    is_new = np.ones(len(points), bool)
    is_new[1:] = (np.diff(points[order], axis=0) != 0).any(axis=1)
    group = np.empty(len(points), np.int64)
    group[order] = np.cumsum(is_new) - 1
    return order[is_new], group, np.bincount(group)


def _neighbour_distances(search: NeighbourSearch, neighbours: int) -> Float[np.ndarray, " D"]:
    """Compute the root mean square distance to the nearest ``neighbours`` other points."""
    distances = np.empty(len(search.order))
    for rows, found, _ in search.of_points(neighbours + 1):
        distances[rows] = np.sqrt(np.mean(found[:, 1:] ** 2, axis=1))
    return distances


def _isolation_cap(distances: Float[np.ndarray, " D"]) -> float:
    # "lower": in a small cloud the percentile must not be the isolated point's own distance
    return ISOLATED_FACTOR * float(np.quantile(distances, 0.99, method="lower"))
